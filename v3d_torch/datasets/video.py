"""A colour video and a depth video of one camera."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.images import depth_to_metres
from v3d_torch.datasets.lists import MAX_STAMP_DIFFERENCE
from v3d_torch.datasets.stored import Cursor, StoredSequence
from v3d_torch.errors import InputError
from v3d_torch.io.download import Progress
from v3d_torch.io.timestamps import associate
from v3d_torch.types import RGBDFrame

# FFmpeg, in OpenCV, writes to stderr by itself what it thinks of a broken file; what matters is raised here.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_WHOLE = 0.9
"""A video whose last frame comes before this share of what the file says is not whole."""

_SUFFIXES = frozenset({".mkv", ".mp4", ".avi", ".mov", ".webm", ".m4v"})


class VideoSequence(StoredSequence):
    """Frames of two videos, paired by their times.

    Depth needs 16 bits a pixel without loss, which FFV1 in an ``.mkv`` or ``.avi`` has (``ffmpeg -c:v ffv1 -pix_fmt
    gray16le``). Both videos are read through once before the first frame: only that tells the times for certain.

    Args:
        path: a folder with a colour video and one called ``depth``, or the colour video of these.
        camera: the user's choice; None takes the ``camera.yaml`` or ``K.txt`` beside the videos.
        fps: frames a second of both; None takes the times that are in the videos.
        progress: told of the frames of the colour video as they are looked through.

    Raises:
        InputError: a video is missing, cannot be decoded or is not what it should be.
    """

    def __init__(
        self,
        path: Path,
        camera: CameraChoice = None,
        *,
        fps: float | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._colour, self._depth = colour, depth = _files(path)
        own = choose_camera(camera, colour.parent)
        (times, cut), (depth_times, depth_cut) = _times(colour, fps, progress), _times(depth, fps, raw=True)
        self._cut = cut or depth_cut
        self._pairs = associate(times, depth_times, MAX_STAMP_DIFFERENCE)
        if not self._pairs:
            raise InputError(
                f"{colour}: no frame lies within {MAX_STAMP_DIFFERENCE} s of one in {depth.name}; do they belong together?"
            )
        super().__init__(path.resolve().stem, [times[i] for i, _ in self._pairs], own)
        self._colours = Cursor(lambda: _frames(colour))
        self._depths = Cursor(lambda: _frames(depth, raw=True))

    def since(self, index: int) -> Iterator[RGBDFrame]:
        """See `StoredSequence.frames_from`.

        Raises:
            InputError: as `__getitem__`; and behind the last frame, where a video breaks off.
        """
        yield from super().frames_from(index)
        if self._cut is not None:
            raise InputError(self._cut)

    def _read(self, index: int) -> tuple[Tensor, Tensor]:
        i, j = self._pairs[index]
        pixels, units = self._colours[i].retrieve()[1], self._depths[j].retrieve()[1]
        image = torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)).permute(2, 0, 1)
        depth = depth_to_metres(units.squeeze(), self.camera.depth_scale)
        return self._check_registered((self._colour, image), (self._depth, depth))


def is_video(path: Path) -> bool:
    """Whether a path is a video, or a folder with a colour and a depth video."""
    return _is_video_file(path) or (path.is_dir() and all(_kinds(path)))


def _is_video_file(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and path.is_file()


def _kinds(folder: Path) -> tuple[list[Path], list[Path]]:
    """Colour and depth videos of a folder, told apart by their names."""
    videos = [path for path in sorted(folder.iterdir()) if _is_video_file(path)]
    depth = [path for path in videos if "depth" in path.stem.lower()]
    return [path for path in videos if path not in depth], depth


def _files(path: Path) -> tuple[Path, Path]:
    """The colour and the depth video that a path means."""
    colour, depth = _kinds(path if path.is_dir() else path.parent)
    if path.is_file():
        colour = [path]
        # Of several pairs side by side, take.mp4 goes with take_depth.mkv.
        depth = [other for other in depth if other.stem.startswith(path.stem)] or depth
    if len(colour) != 1 or len(depth) != 1:
        found = ", ".join(file.name for file in colour + depth)
        raise InputError(
            f"{path}: a colour and a depth video belong together, here are {found}; name them such as take.mp4 and"
            " take_depth.mkv and give the first"
        )
    return colour[0], depth[0]


def _times(
    path: Path, fps: float | None, progress: Progress | None = None, *, raw: bool = False
) -> tuple[list[float], str | None]:
    """Seconds of every frame, strictly increasing; and a sentence where there are fewer than the file says."""
    times: list[float] = []
    end = last = 0.0
    for number, capture in enumerate(_frames(path, raw=raw)):
        if number == 0 and raw:
            _check_depth(path, capture)
        last = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        end = (capture.get(cv2.CAP_PROP_FRAME_COUNT) - 1) / max(capture.get(cv2.CAP_PROP_FPS), 1e-3)
        times.append(number / fps if fps is not None else last)
        if progress is not None:
            progress(number + 1, max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), number + 1))
    if not times:
        raise InputError(f"{path}: is no video that can be decoded; copy it again, or convert it with ffmpeg")
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise InputError(f"{path}: its times do not increase; give the frames a second with --fps")
    cut = f"{path}: breaks off at {last:.1f} of {end:.1f} s; copy it again" if last < _WHOLE * end else None
    return times, cut


def _check_depth(path: Path, capture: cv2.VideoCapture) -> None:
    pixels = capture.retrieve()[1]
    if pixels.dtype != np.uint16 or pixels.squeeze().ndim != 2:
        raise InputError(
            f"{path}: has not 16 bits of grey a pixel, as depth has; export it again with"
            " ffmpeg -c:v ffv1 -pix_fmt gray16le"
        )


def _frames(path: Path, *, raw: bool = False) -> Iterator[cv2.VideoCapture]:
    """The video at each of its frames in turn, to be asked for its time or its pixels."""
    with _quiet():
        # Unless told so, OpenCV turns every video into 8-bit colour.
        parameters = [cv2.CAP_PROP_CONVERT_RGB, 0] if raw else []
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, parameters)
    while capture.grab():
        yield capture


@contextmanager
def _quiet() -> Iterator[None]:
    """Without OpenCV's warning on stderr that it does as it was told."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
