"""Opening of a source of RGB-D frames by name or path."""

from __future__ import annotations

import os
import shlex
import warnings
from pathlib import Path

from v3d_torch.datasets.base import RGBDSequence, RGBDStream
from v3d_torch.datasets.cameras import CameraChoice
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.locate import find_or_download, is_live
from v3d_torch.datasets.realsense import open_realsense_camera
from v3d_torch.datasets.sequence_names import BUILT_IN_SEQUENCES
from v3d_torch.datasets.sources import SourceOptions, open_path, reject_options
from v3d_torch.datasets.stored import StoredSequence
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.errors import DepthScaleWarning, GroundTruthWarning, InputError
from v3d_torch.io.download import Progress
from v3d_torch.io.paths import StrPath, cache_dir, expand_user

_MIN_FPS, _MAX_FPS = 0.01, 1e4
"""Accepted range of frame rates, Hz: far wider than that of cameras; it excludes 0, negative values and NaN."""


def open_source(
    name: StrPath,
    *,
    data_root: StrPath | None = None,
    camera: CameraChoice = None,
    options: SourceOptions | None = None,
    download: bool = True,
    progress: Progress | None = None,
    skip_broken: bool = False,
) -> RGBDStream:
    """Open a source of RGB-D frames: a stored sequence, a recording or a live camera.

    Args:
        name: One of

            - ``demo``, ``demo:sitting``, ``demo:things``: a rendered sequence;
            - ``realsense:`` or ``realsense:SERIAL``: a connected camera;
            - the path of a folder or file of any kind in `v3d_torch.datasets.sources.SOURCES`;
            - the name of a sequence in ``data_root``;
            - the name of a TUM sequence, such as ``fr3/w/xyz`` (see `canonical_name` for other spellings).
        data_root: Folder with the user's sequences; None for ``$V3D_DATA``, or else the cache (``$V3D_CACHE``).
        camera: A camera, the name of a preset or a camera file; None for the camera of the source.
        options: Options for sources that do not describe themselves completely; None for the defaults.
        download: True if a TUM sequence that is not on disk is downloaded.
        progress: Callback for the number of downloaded bytes, or of rendered frames; None for no reports.
        skip_broken: True to report missing image files and broken frames only when such a frame is read, and not when
            the sequence is opened; see `v3d_torch.datasets.readable_frames.ReadableFrames`.

    Returns:
        An `RGBDSequence` if the frames are stored, or else a stream.

    Raises:
        InputError: If there is no such source or its content is invalid.
        DownloadError: If the sequence is not on disk and cannot be downloaded.
        OutputError: If a downloaded or rendered sequence cannot be written to the disk.

    Warns:
        GroundTruthWarning: If the ground truth cannot be read; ``groundtruth`` is None then.
        DepthScaleWarning: If the depth scale is not stated, and was estimated from the images.
    """
    return _open(name, data_root, camera, options or SourceOptions(), download, progress, skip_broken)


def load_sequence(
    name: StrPath,
    *,
    data_root: StrPath | None = None,
    camera: CameraChoice = None,
    options: SourceOptions | None = None,
    download: bool = True,
    progress: Progress | None = None,
    skip_broken: bool = False,
) -> RGBDSequence:
    """Open a sequence with a fixed number of frames that can be indexed.

    Arguments, errors and warnings are those of `open_source`.

    Returns:
        The sequence; ``sequence[i]`` is an `RGBDFrame`.

    Raises:
        InputError: Also if the source is a stream, such as a live camera.
    """
    source = _open(name, data_root, camera, options or SourceOptions(), download, progress, skip_broken)
    if not isinstance(source, RGBDSequence):
        raise InputError(
            f"{name}: is a stream, whose frames cannot be indexed; record it first with"
            f" v3d-torch record --seq {shlex.quote(str(name))} --out FOLDER"
        )
    return source


def _open(
    name: StrPath,
    data_root: StrPath | None,
    camera: CameraChoice,
    options: SourceOptions,
    download: bool,
    progress: Progress | None,
    skip_broken: bool,
) -> RGBDStream:
    """Check the arguments and open a source, with warnings at the line that called this module.

    File system errors become `InputError`.
    """
    if options.fps is not None and not _MIN_FPS <= options.fps <= _MAX_FPS:
        raise InputError(f"--fps {options.fps:g}: is out of range; pass between {_MIN_FPS:g} and {_MAX_FPS:g} Hz")
    try:
        root = None if data_root is None else expand_user(data_root)
        source = _open_by_name(os.fspath(name), root, camera, options, download, progress, skip_broken)
    except OSError as error:  # such as a folder without permission or a name that is too long
        raise InputError(
            f"{error.filename or name}: cannot be read ({error.strerror}); check its name and permissions"
        ) from error
    if isinstance(source, StoredSequence) and source.groundtruth_error is not None:
        warnings.warn(f"{source.groundtruth_error}; continuing without ground truth", GroundTruthWarning, stacklevel=3)
    if isinstance(source, ImageSequence) and source.depth_scale_note is not None:
        warnings.warn(f"{source.name}: {source.depth_scale_note}", DepthScaleWarning, stacklevel=3)
    return source


def _open_by_name(
    name: str,
    data_root: Path | None,
    camera: CameraChoice,
    options: SourceOptions,
    download: bool,
    progress: Progress | None,
    skip_broken: bool,
) -> RGBDStream:
    if name in BUILT_IN_SEQUENCES:
        # Imported here because rendering needs libraries that other sources do not need.
        from v3d_torch.datasets.demo import ensure_demo

        reject_options(name, "a rendered sequence", options, frozenset())
        return TUMSequence(ensure_demo(cache_dir(), progress, name), camera, name=name)
    if is_live(name):
        if name == "realsense" and Path(name).exists():
            raise InputError(f"{name}: is a path and the name of a camera; pass ./{name} or {name}: to choose one")
        reject_options(name.removesuffix(":"), "a live camera", options, frozenset({"fps"}))
        return open_realsense_camera(name, camera, fps=options.fps)
    path = find_or_download(name, data_root=data_root, download=download, progress=progress)
    source = open_path(path, camera, options, progress)
    if isinstance(source, ImageSequence):
        source.check(path, skip_broken=skip_broken)
    return source
