"""RGB-D sequences stored as a pair of videos, one of colour and one of 16-bit depth."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import chain, pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.cursor import Cursor
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.lists import MAX_STAMP_DIFFERENCE, check_paired
from v3d_torch.errors import InputError
from v3d_torch.io.download import Progress
from v3d_torch.io.names import path_label
from v3d_torch.io.timestamps import associate
from v3d_torch.types import RGBDFrame

# FFmpeg inside OpenCV prints warnings about damaged files to stderr; this module raises the errors that matter.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_MIN_DECODED_FRACTION = 0.9
"""A video counts as truncated if its last frame comes before this fraction of the duration that its header states.

The stated duration is approximate: OpenCV estimates the number of frames if the file does not store it.
"""

_SAMPLING_RANGE = 64
"""Number of frames at the beginning from which samples are taken to estimate an unknown depth scale: all frames before
a sample are decoded."""

_SUFFIXES = frozenset({".mkv", ".mp4", ".avi", ".mov", ".webm", ".m4v"})


class VideoSequence(ImageSequence):
    """RGB-D frames of a colour video and a depth video, paired by their timestamps.

    Depth needs lossless 16-bit video, such as FFV1 in an ``.mkv`` or ``.avi`` (``ffmpeg -c:v ffv1 -pix_fmt
    gray16le``). The constructor decodes both videos once, because only decoding gives reliable timestamps.

    Args:
        path: Folder with a colour video and a video called ``depth``, or the colour video of such a pair.
        camera: Camera chosen by the user; None for the ``camera.yaml`` or ``K.txt`` next to the videos.
        fps: Frame rate of both videos, Hz; None for the timestamps in the videos.
        progress: Called with the number of colour frames read so far and their total.

    Raises:
        InputError: If a video is missing, cannot be decoded, or has the wrong format.
    """

    def __init__(
        self,
        path: Path,
        camera: CameraChoice = None,
        *,
        fps: float | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._colour_path, self._depth_path = colour_path, depth_path = _find_pair(path)
        chosen = choose_camera(camera, colour_path.parent, image_size=lambda: _frame_size(depth_path))
        stamps, colour_truncation = _read_stamps(colour_path, fps, progress)
        depth_stamps, depth_truncation = _read_stamps(depth_path, fps, is_depth=True)
        self._truncation = colour_truncation or depth_truncation
        self._pairs = associate(stamps, depth_stamps, MAX_STAMP_DIFFERENCE)
        if not self._pairs:
            raise InputError(
                f"{colour_path}: no frame is within {MAX_STAMP_DIFFERENCE} s of a frame in {depth_path.name}; check"
                " that both videos belong to the same recording"
            )
        pairing_note = check_paired(colour_path, stamps, depth_stamps, self._pairs)
        super().__init__(
            path_label(path),
            [stamps[i] for i, _ in self._pairs],
            chosen,
            delays=[depth_stamps[j] - stamps[i] for i, j in self._pairs],
        )
        self.pairing_note = pairing_note
        self._colour_frames = Cursor(partial(_open_frames, colour_path))
        self._depth_frames = Cursor(partial(_open_frames, depth_path, is_depth=True))
        self._settle_depth_scale(path, _SAMPLING_RANGE)

    def frames_from(self, index: int) -> Iterator[RGBDFrame]:
        """Read the frames from ``index`` on, see `StoredSequence.frames_from`.

        Raises:
            InputError: As `__getitem__`; and after the last frame if a video is truncated.
        """
        return chain(super().frames_from(index), self._raise_truncation())

    def _raise_truncation(self) -> Iterator[RGBDFrame]:
        """Iterate over no frames; raise an error if a video is truncated."""
        if self._truncation is not None:
            raise InputError(self._truncation)
        yield from ()

    def _sources(self, index: int) -> tuple[Path, Path]:
        return self._colour_path, self._depth_path

    def _read_colour(self, index: int) -> Tensor:
        pixels = _retrieve(self._colour_frames[self._pairs[index][0]])
        return torch.from_numpy(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)).permute(2, 0, 1)

    def _read_depth(self, index: int) -> NDArray[np.generic]:
        return _retrieve(self._depth_frames[self._pairs[index][1]]).squeeze()


def is_video(path: Path) -> bool:
    """Check whether a path is a video file, or a folder with a colour video and a depth video."""
    return _is_video_file(path) or (path.is_dir() and all(_list_videos(path)))


def _is_video_file(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and path.is_file()


def _list_videos(folder: Path) -> tuple[list[Path], list[Path]]:
    """List the colour videos and the depth videos of a folder; depth videos have "depth" in their names."""
    videos = [path for path in sorted(folder.iterdir()) if _is_video_file(path)]
    depth = [path for path in videos if "depth" in path.stem.lower()]
    return [path for path in videos if path not in depth], depth


def _find_pair(path: Path) -> tuple[Path, Path]:
    """Find the colour video and the depth video for a folder or a colour video."""
    colour, depth = _list_videos(path if path.is_dir() else path.parent)
    if path.is_file():
        if path in depth:
            raise InputError(f"{path}: is a depth video by its name; give the colour video of the pair")
        # With several pairs in one folder, take.mp4 belongs to take_depth.mkv.
        named = [other for other in depth if _without_depth(other) == path.stem.lower()]
        depth = named or (depth if len(colour) == 1 else [])
        colour = [path]
    if len(colour) != 1 or len(depth) != 1:
        found = ", ".join(file.name for file in colour + depth)
        raise InputError(
            f"{path}: expected one colour and one depth video, found {found}; name them like take.mp4 and"
            " take_depth.mkv and pass the first"
        )
    return colour[0], depth[0]


def _without_depth(path: Path) -> str:
    """Name of a depth video without the word "depth" and the separator before or after it, in lower case."""
    return re.sub(r"[-_. ]depth|depth[-_. ]?", "", path.stem.lower(), count=1)


def _frame_size(path: Path) -> tuple[int, int]:
    """Width and height of a depth video."""
    capture = next(_open_frames(path, is_depth=True), None)
    if capture is None:
        raise _undecodable_error(path)
    height, width = _retrieve(capture).shape[:2]
    return width, height


def _undecodable_error(path: Path) -> InputError:
    return InputError(f"{path}: cannot be decoded as a video; copy it again, or convert it with ffmpeg")


def _read_stamps(
    path: Path, fps: float | None, progress: Progress | None = None, *, is_depth: bool = False
) -> tuple[list[float], str | None]:
    """Decode a video to get its timestamps.

    Returns:
        Timestamps of all frames, seconds, strictly increasing; and an error message if the video is truncated.
    """
    stamps: list[float] = []
    duration = position = 0.0
    for index, capture in enumerate(_open_frames(path, is_depth=is_depth)):
        if index == 0 and is_depth:
            _check_depth_format(path, capture)
        position = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        duration = (capture.get(cv2.CAP_PROP_FRAME_COUNT) - 1) / max(capture.get(cv2.CAP_PROP_FPS), 1e-3)
        stamps.append(index / fps if fps is not None else position)
        if progress is not None:
            progress(index + 1, max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), index + 1))
    if not stamps:
        raise _undecodable_error(path)
    if any(later <= earlier for earlier, later in pairwise(stamps)):
        raise InputError(f"{path}: its timestamps do not increase; pass the frame rate with --fps")
    if position < _MIN_DECODED_FRACTION * duration:
        return stamps, f"{path}: is truncated at {position:.1f} of {duration:.1f} s; copy it again"
    return stamps, None


def _check_depth_format(path: Path, capture: cv2.VideoCapture) -> None:
    pixels = _retrieve(capture)
    if pixels.dtype != np.uint16 or pixels.squeeze().ndim != 2:
        raise InputError(
            f"{path}: depth is not one channel of 16 bits; export it again with ffmpeg -c:v ffv1 -pix_fmt gray16le"
        )


def _open_frames(path: Path, *, is_depth: bool = False) -> Iterator[cv2.VideoCapture]:
    """Yield the video capture positioned at each frame in turn, to read its timestamp or retrieve its pixels."""
    # A capture with threads of its own blocks a forked process, such as a worker of a data loader, that deletes it.
    parameters = [cv2.CAP_PROP_N_THREADS, 1]
    if is_depth:  # by default OpenCV converts all videos to 8-bit colour
        parameters += [cv2.CAP_PROP_CONVERT_RGB, 0]
    name = str(path.absolute())  # FFmpeg reads the relative name 10:30.avi as a protocol
    try:
        name.encode()
    except UnicodeEncodeError as error:  # ends the process in OpenCV
        raise InputError(f"{path}: has a name that is not UTF-8; rename the file and its folders") from error
    with _silence_opencv():
        capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, parameters)
    while capture.grab():
        yield capture


def _retrieve(capture: cv2.VideoCapture) -> NDArray[np.uint8 | np.uint16]:
    """Pixels of the frame at which a capture is."""
    with _silence_opencv():
        return np.asarray(capture.retrieve()[1])


@contextmanager
def _silence_opencv() -> Iterator[None]:
    """Suppress OpenCV's warnings on stderr about formats that it does not convert to RGB, as requested."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
