"""Cases with pairs of a colour video and a depth video."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from helpers.corpus.base import CAMERA, FRAMES, NOISE, camera_position, colour, depth
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    Workspace,
    add_options,
    all_of,
    fails_at_frame,
    first_half,
)


def save(path: Path, images: list[NDArray[np.generic]]) -> None:
    """Write a lossless video at 10 Hz, with the bit depth of the images."""
    first = images[0]
    bits = cv2.CV_16U if first.dtype == np.uint16 else cv2.CV_8U
    writer_options = [cv2.VIDEOWRITER_PROP_DEPTH, bits, cv2.VIDEOWRITER_PROP_IS_COLOR, int(first.ndim == 3)]
    size = (first.shape[1], first.shape[0])
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 10.0, size, writer_options)
    for image in images:
        writer.write(image)
    writer.release()


def videos(place: Workspace) -> None:
    """Write the sequence as a pair of videos."""
    folder = place.root / "take"
    folder.mkdir()
    (folder / "camera.yaml").write_text(CAMERA)
    save(folder / "colour.mkv", [colour(*camera_position(i)) for i in range(FRAMES)])
    save(folder / "depth.mkv", [depth() for _ in range(FRAMES)])
    place.seq = str(folder)


def change_bytes(file: str, change: Callable[[bytes], bytes]) -> Damage:
    def make(place: Workspace) -> None:
        videos(place)
        path = place.root / "take" / file
        path.write_bytes(change(path.read_bytes()))

    return make


def replace_video(file: str, image: NDArray[np.generic]) -> Damage:
    return all_of(videos, lambda place: save(place.root / "take" / file, FRAMES * [image]))


CASES = [
    Case("valid pair", videos, Succeeds(max_ate=None)),
    Case(
        "truncated colour",
        change_bytes("colour.mkv", first_half),
        fails_at_frame(3, "{root}/take/colour.mkv: is truncated at 0.2 of 0.7 s; copy it again"),
    ),
    Case(
        "truncated depth",
        change_bytes("depth.mkv", first_half),
        fails_at_frame(2, "{root}/take/depth.mkv: is truncated at 0.1 of 0.7 s; copy it again"),
    ),
    Case(
        "depth truncated in its header",
        change_bytes("depth.mkv", lambda content: content[:300]),
        Fails("{root}/take/depth.mkv: cannot be decoded as a video; copy it again, or convert it with ffmpeg"),
    ),
    Case(
        "random bytes",
        change_bytes("colour.mkv", lambda content: NOISE),
        Fails("{root}/take/colour.mkv: cannot be decoded as a video; copy it again, or convert it with ffmpeg"),
    ),
    Case(
        "empty file",
        change_bytes("depth.mkv", lambda content: b""),
        Fails("{root}/take/depth.mkv: cannot be decoded as a video; copy it again, or convert it with ffmpeg"),
    ),
    Case(
        "text file",
        change_bytes("colour.mkv", lambda content: b"the video\n" * 100),
        Fails("{root}/take/colour.mkv: cannot be decoded as a video; copy it again, or convert it with ffmpeg"),
    ),
    Case(
        "8-bit depth",
        replace_video("depth.mkv", colour(0)),
        Fails(
            "{root}/take/depth.mkv: depth is not one channel of 16 bits; export it again with"
            " ffmpeg -c:v ffv1 -pix_fmt gray16le"
        ),
    ),
    Case(
        "depth of another size",
        replace_video("depth.mkv", depth()[::2, ::2].copy()),
        Fails(
            "{root}/take/depth.mkv: has 64x48 pixels, but its colour image has 128x96; export depth that is"
            " registered to the colour image"
        ),
    ),
    Case(
        "two colour videos",
        replace_video("other.mkv", colour(0)),
        Fails(
            "{root}/take: expected one colour and one depth video, found colour.mkv, other.mkv,"
            " depth.mkv; name them like take.mp4 and take_depth.mkv and pass the first"
        ),
    ),
    Case(
        "no camera",
        all_of(videos, lambda place: (place.root / "take" / "camera.yaml").unlink()),
        Fails(
            "{root}/take: has no camera parameters; add a camera.yaml (fx, fy, cx, cy, width, height,"
            " depth_scale) or pass --camera with a file or one of d435i, tum_fr1, tum_fr2, tum_fr3"
        ),
    ),
    Case(
        "--fps 0",
        all_of(videos, add_options("--fps", "0")),
        Fails("--fps 0: is out of range; pass between 0.01 and 10000 Hz"),
    ),
    Case(
        "--fps nan",
        all_of(videos, add_options("--fps", "nan")),
        Fails("--fps nan: is out of range; pass between 0.01 and 10000 Hz"),
    ),
    Case(
        "--fps inf",
        all_of(videos, add_options("--fps", "inf")),
        Fails("--fps inf: is out of range; pass between 0.01 and 10000 Hz"),
    ),
]
