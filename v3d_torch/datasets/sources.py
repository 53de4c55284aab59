"""The kinds of source, and which of them a path holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from v3d_torch.datasets.base import RGBDStream
from v3d_torch.datasets.bonn import BonnSequence, is_bonn
from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.icl_nuim import ICLNUIMSequence, is_icl_nuim
from v3d_torch.datasets.image_folder import ImageFolder, is_image_folder
from v3d_torch.datasets.openloris import OpenLORISSequence, is_openloris
from v3d_torch.datasets.realsense import is_recording, open_recording
from v3d_torch.datasets.ros import BagSequence, is_bag
from v3d_torch.datasets.scannet import ScanNetSequence, is_scannet
from v3d_torch.datasets.seven_scenes import SevenScenesSequence, is_seven_scenes
from v3d_torch.datasets.tum import TUMSequence, is_tum
from v3d_torch.datasets.video import VideoSequence, is_video
from v3d_torch.errors import InputError
from v3d_torch.io.download import Progress


@dataclass(frozen=True)
class SourceOptions:
    """What a user may say of a source that does not say it itself.

    Args:
        rgb_topic: of a bag's colour images; None guesses.
        depth_topic: of its depth images; None guesses.
        info_topic: of its camera; None guesses.
        fps: frames a second, of images whose names are no times, or asked of a live camera.
    """

    rgb_topic: str | None = None
    depth_topic: str | None = None
    info_topic: str | None = None
    fps: float | None = None


@dataclass(frozen=True)
class Source:
    """A kind of source.

    Args:
        what: in words, for messages.
        holds: whether a path is one.
        open: opens it with the user's camera, the options that it takes, and a bar for what takes long.
        options: names of `SourceOptions` that mean something to it.
    """

    what: str
    holds: Callable[[Path], bool]
    open: Callable[[Path, CameraChoice, SourceOptions, Progress | None], RGBDStream]
    options: frozenset[str] = frozenset()


def _open_bag(path: Path, camera: CameraChoice, options: SourceOptions, progress: Progress | None) -> RGBDStream:
    topics = {name: value for name, value in asdict(options).items() if name in _TOPICS}
    return BagSequence(path, camera, **topics, progress=progress)


_TOPICS = frozenset({"rgb_topic", "depth_topic", "info_topic"})

SOURCES = (
    Source("a RealSense recording", is_recording, lambda path, camera, *_: open_recording(path, camera)),
    Source("a bag", is_bag, _open_bag, _TOPICS),
    Source("an OpenLORIS-Scene package", is_openloris, lambda path, camera, *_: OpenLORISSequence(path, camera)),
    Source("an ICL-NUIM sequence", is_icl_nuim, lambda path, camera, *_: ICLNUIMSequence(path, camera)),
    Source("a Bonn RGB-D Dynamic sequence", is_bonn, lambda path, camera, *_: BonnSequence(path, camera)),
    Source("a folder in TUM layout", is_tum, lambda path, camera, *_: TUMSequence(path, camera)),
    Source("a 7-Scenes sequence", is_seven_scenes, lambda path, camera, *_: SevenScenesSequence(path, camera)),
    Source("a folder as ScanNet's", is_scannet, lambda path, camera, *_: ScanNetSequence(path, camera)),
    Source(
        "a video",
        is_video,
        lambda path, camera, options, progress: VideoSequence(path, camera, fps=options.fps, progress=progress),
        frozenset({"fps"}),
    ),
    Source(
        "a folder of images",
        is_image_folder,
        lambda path, camera, options, _: ImageFolder(path, camera, fps=options.fps),
        frozenset({"fps"}),
    ),
)
"""In the order in which they are tried: what could be taken for another, less special kind comes before it."""


_UNPACK = {
    (".tgz", ".tar", ".tar.gz", ".zip", ".7z", ".rar"): "is an archive; unpack it and give the folder",
    (".sens",): "is a recording of ScanNet's; export it with ScanNet's SensReader and give that folder",
}
"""What is no source yet, by the ends of its name, and what makes one of it."""

_UNKNOWN = (
    "is no sequence of a known kind; the README lists them, the simplest is a folder with a folder rgb of colour and a"
    " folder depth of depth images"
)


def is_source(path: Path) -> bool:
    """Whether a path holds anything of a known kind; opening it tells whether it is in order."""
    return any(source.holds(path) for source in SOURCES)


def open_path(path: Path, camera: CameraChoice, options: SourceOptions, progress: Progress | None) -> RGBDStream:
    """Open what a path holds.

    Raises:
        InputError: it holds nothing known, an option means nothing to it, or something in it is wrong.
    """
    for source in SOURCES:
        if source.holds(path):
            reject_options(path, source.what, options, source.options)
            return source.open(path, camera, options, progress)
    how = next((how for ends, how in _UNPACK.items() if path.name.lower().endswith(ends)), _UNKNOWN)
    if inside := [entry for entry in sorted(path.glob("*/")) if is_source(entry)]:
        how = f"is no sequence itself but holds {len(inside)}, such as {inside[0].name}; give {inside[0]}"
    raise InputError(f"{path}: {how}")


def reject_options(source: object, what: str, options: SourceOptions, taken: frozenset[str]) -> None:
    """Raise InputError where an option is set that ``source`` has no use for."""
    for name, value in asdict(options).items():
        if value is not None and name not in taken:
            raise InputError(f"{source}: is {what}, --{name.replace('_', '-')} means nothing to it; leave it out")
