"""Sources of RGB-D frames; `open_source` opens any of them by name, `load_sequence` those that have an end."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

from v3d_torch.datasets.base import RGBDSequence, RGBDStream
from v3d_torch.datasets.cameras import CameraChoice, load_camera
from v3d_torch.datasets.locate import sequence_path
from v3d_torch.datasets.names import PAPER_SEQUENCES, canonical_name, short_name
from v3d_torch.datasets.realsense import open_camera
from v3d_torch.datasets.sources import SourceOptions, open_path, reject_options
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import GroundTruthWarning, InputError
from v3d_torch.io.download import Progress, cache_dir
from v3d_torch.io.paths import StrPath, expand_user

__all__ = [
    "PAPER_SEQUENCES",
    "RGBDSequence",
    "RGBDStream",
    "SourceOptions",
    "TUMSequence",
    "canonical_name",
    "load_camera",
    "load_sequence",
    "open_source",
    "short_name",
]

_RATES = (0.01, 1e4)
"""Between which frames a second lie."""


def open_source(
    name: StrPath,
    *,
    data_root: StrPath | None = None,
    camera: CameraChoice = None,
    options: SourceOptions | None = None,
    download: bool = True,
    progress: Progress | None = None,
) -> RGBDStream:
    """Open whatever gives RGB-D frames.

    Args:
        name: ``demo``; ``realsense:`` for a camera that is plugged in, ``realsense:SERIAL`` for one of several; a
            folder or file of any kind in `v3d_torch.datasets.sources.SOURCES`; a name such as ``fr3/w/xyz``
            (`canonical_name` lists the ways to write it); or the name of something in ``data_root``.
        data_root: where sequences are kept; None takes ``$V3D_DATA``, then the cache (``$V3D_CACHE``).
        camera: a camera, a preset's name or a camera file; None takes the source's own.
        options: what the source does not say itself.
        download: whether a TUM sequence that is not here is downloaded.
        progress: told of the bytes of a download, or of the frames of the demo as they are made.

    Returns:
        An `RGBDSequence` where the frames are stored, else a stream.

    Raises:
        InputError: there is no such source, or something in it is wrong.
        DownloadError: it is not here and cannot be downloaded.

    Warns:
        GroundTruthWarning: its ground truth cannot be read; ``groundtruth`` is None then.
    """
    source = _checked(name, data_root, camera, options or SourceOptions(), download, progress)
    _warn_of_truth(source)
    return source


def _checked(
    name: StrPath,
    data_root: StrPath | None,
    camera: CameraChoice,
    options: SourceOptions,
    download: bool,
    progress: Progress | None,
) -> RGBDStream:
    if options.fps is not None and not _RATES[0] <= options.fps <= _RATES[1]:
        raise InputError(f"--fps {options.fps:g}: give frames a second, between {_RATES[0]:g} and {_RATES[1]:g}")
    try:
        root = None if data_root is None else expand_user(data_root)
        return _open(os.fspath(name), root, camera, options, download, progress)
    except OSError as error:  # a folder that may not be looked into, a name that is too long
        raise InputError(
            f"{error.filename or name}: cannot be read ({error.strerror}); check its name and who may read it"
        ) from error


def _warn_of_truth(source: RGBDStream) -> None:
    """Say where the caller of this module stands that a source came without its ground truth."""
    if isinstance(source, StoredSequence) and source.groundtruth_error is not None:
        warnings.warn(f"{source.groundtruth_error}; there are no true poses", GroundTruthWarning, stacklevel=3)


def _open(
    name: str,
    data_root: Path | None,
    camera: CameraChoice,
    options: SourceOptions,
    download: bool,
    progress: Progress | None,
) -> RGBDStream:
    if name == "demo":
        # The demo is rendered on first use, with libraries that nothing else here needs.
        from v3d_torch.datasets.demo import ensure_demo

        reject_options(name, "the demo", options, frozenset())
        return TUMSequence(ensure_demo(cache_dir(), progress), camera, name="demo")
    if name.partition(":")[0] == "realsense":
        reject_options(name, "a live camera", options, frozenset({"fps"}))
        return open_camera(name, camera, fps=options.fps)
    path = sequence_path(name, data_root=data_root, download=download, progress=progress)
    source = open_path(path, camera, options, progress)
    if isinstance(source, StoredSequence):
        source.check_first_frame(path)
    return source


def load_sequence(
    name: StrPath,
    *,
    data_root: StrPath | None = None,
    camera: CameraChoice = None,
    options: SourceOptions | None = None,
    download: bool = True,
    progress: Progress | None = None,
) -> RGBDSequence:
    """Open a sequence, whose frames have a number and may be read in any order; see `open_source`.

    Raises:
        InputError: as `open_source`, or the source is a stream.
        DownloadError: as `open_source`.

    Warns:
        GroundTruthWarning: as `open_source`.
    """
    source = _checked(name, data_root, camera, options or SourceOptions(), download, progress)
    if not isinstance(source, RGBDSequence):
        raise InputError(
            f"{name}: is a stream, whose frames come only once and in order; save it first with"
            f" python -m v3d_torch record --seq {name} --out FOLDER"
        )
    _warn_of_truth(source)
    return source
