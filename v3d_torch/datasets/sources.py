"""Supported kinds of sources, and recognition of the kind of a path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from v3d_torch.datasets.base import RGBDStream
from v3d_torch.datasets.bonn import BonnSequence, is_bonn
from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.eth3d import ETH3DSequence, is_eth3d
from v3d_torch.datasets.icl_nuim import ICLNUIMSequence, is_icl_nuim
from v3d_torch.datasets.image_folder import ImageFolder, is_image_folder
from v3d_torch.datasets.locate import is_tum
from v3d_torch.datasets.openloris import OpenLORISSequence, is_openloris
from v3d_torch.datasets.realsense import is_realsense_recording, open_realsense_recording
from v3d_torch.datasets.replica import ReplicaSequence, is_replica
from v3d_torch.datasets.ros import BagSequence, is_bag
from v3d_torch.datasets.scannet import ScanNetSequence, is_scannet
from v3d_torch.datasets.seven_scenes import SevenScenesSequence, is_seven_scenes
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.datasets.video import VideoSequence, is_video
from v3d_torch.errors import InputError
from v3d_torch.io.download import Progress


@dataclass(frozen=True)
class SourceOptions:
    """Options for sources whose files do not state everything.

    Attributes:
        rgb_topic: Topic of a bag's colour images; None for automatic selection.
        depth_topic: Topic of a bag's depth images; None for automatic selection.
        info_topic: Topic of a bag's camera info; None for automatic selection.
        fps: Frame rate, Hz: of images without timestamps in their names, of videos, or requested from a live camera;
            None for the source's own timestamps or the camera's default.
    """

    rgb_topic: str | None = None
    depth_topic: str | None = None
    info_topic: str | None = None
    fps: float | None = None


@dataclass(frozen=True)
class Source:
    """A kind of source.

    Attributes:
        description: Description with an article, for messages.
        matches: Function that checks whether a path is a source of this kind.
        open: Function that opens a path with the camera chosen by the user, the options and a progress callback.
        options: Names of the supported fields of `SourceOptions`.
    """

    description: str
    matches: Callable[[Path], bool]
    open: Callable[[Path, CameraChoice, SourceOptions, Progress | None], RGBDStream]
    options: frozenset[str] = frozenset()


_TOPICS = frozenset({"rgb_topic", "depth_topic", "info_topic"})


def _open_bag(path: Path, camera: CameraChoice, options: SourceOptions, progress: Progress | None) -> RGBDStream:
    topics = {name: value for name, value in asdict(options).items() if name in _TOPICS}
    return BagSequence(path, camera, **topics, progress=progress)


SOURCES = (
    Source(
        "a RealSense recording", is_realsense_recording, lambda path, camera, *_: open_realsense_recording(path, camera)
    ),
    Source("a bag", is_bag, _open_bag, _TOPICS),
    Source("an OpenLORIS-Scene package", is_openloris, lambda path, camera, *_: OpenLORISSequence(path, camera)),
    Source("an ICL-NUIM sequence", is_icl_nuim, lambda path, camera, *_: ICLNUIMSequence(path, camera)),
    Source("a Bonn RGB-D Dynamic sequence", is_bonn, lambda path, camera, *_: BonnSequence(path, camera)),
    Source("an ETH3D sequence", is_eth3d, lambda path, camera, *_: ETH3DSequence(path, camera)),
    Source("a folder in TUM layout", is_tum, lambda path, camera, *_: TUMSequence(path, camera)),
    Source("a 7-Scenes sequence", is_seven_scenes, lambda path, camera, *_: SevenScenesSequence(path, camera)),
    Source("a Replica sequence", is_replica, lambda path, camera, *_: ReplicaSequence(path, camera)),
    Source("a ScanNet export", is_scannet, lambda path, camera, *_: ScanNetSequence(path, camera)),
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
"""Supported kinds of sources, in the order of recognition: special kinds come before similar general ones."""

_CONVERTIBLE = {
    (".tgz", ".tar", ".tar.gz", ".zip", ".7z", ".rar"): "is an archive; unpack it and pass the folder",
    (".sens",): "is a ScanNet recording; export it with ScanNet's SensReader and pass the exported folder",
}
"""Message for each unsupported file type that the user can convert, by suffixes."""

_UNKNOWN = (
    "is not a sequence of a supported format; the README lists the formats, of which the simplest is a folder with"
    " colour images in a subfolder rgb and depth images in a subfolder depth"
)
"""Message for all other paths."""


def is_source(path: Path) -> bool:
    """Check whether a path is a source of any supported kind. Opening the source checks its content.

    A path that cannot be read is none: many file systems have such a folder, for example ``lost+found``. A damaged bag
    is one, so that it is not left out of a pattern without an error.
    """
    try:
        return any(source.matches(path) for source in SOURCES)
    except InputError:  # raised again when the path is opened
        return True
    except OSError:
        return False


def open_path(path: Path, camera: CameraChoice, options: SourceOptions, progress: Progress | None) -> RGBDStream:
    """Open a source from a path.

    Args:
        path: File or folder of any kind in `SOURCES`.
        camera: Camera chosen by the user; None for the camera of the source.
        options: Options of the source.
        progress: Callback for the progress of slow sources; None for no reports.

    Raises:
        InputError: If the path is not a supported source, does not support an option, or has invalid content.
    """
    for source in SOURCES:
        if source.matches(path):
            reject_options(path, source.description, options, source.options)
            return source.open(path, camera, options, progress)
    message = next((text for suffixes, text in _CONVERTIBLE.items() if path.name.lower().endswith(suffixes)), _UNKNOWN)
    if sequences := [entry for entry in sorted(path.glob("*/")) if is_source(entry)]:
        message = f"is not a sequence but contains {len(sequences)}, such as {sequences[0].name}; pass {sequences[0]}"
    raise InputError(f"{path}: {message}")


def reject_options(source: object, description: str, options: SourceOptions, supported: frozenset[str]) -> None:
    """Raise an error if an option is set that the source does not support.

    Args:
        source: Path or name of the source, for messages.
        description: Description of its kind, for messages.
        options: Options given by the user.
        supported: Names of the supported options.

    Raises:
        InputError: If another option is set.
    """
    for name, value in asdict(options).items():
        if value is not None and name not in supported:
            raise InputError(
                f"{source}: is {description}, which does not support --{name.replace('_', '-')}; remove this option"
            )
