"""Map files: save a map, and load it in a later run for localisation, extension or drawing.

A map file is a zip archive of NumPy arrays (npz) without pickled objects, so that loading a file runs no code from it.
Covisibility and the keyframe database are not stored, because they are computed from the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.array_file import ArrayFile, open_array_file, write_array_file
from v3d_torch.io.paths import StrPath
from v3d_torch.mapping.map_columns import OPTIONAL_COLUMNS, fill_from_columns, find_inconsistency, to_columns
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.odometry.rolling_shutter import Readout

MAP_FORMAT = "v3d_torch map"
"""Format that a map file states."""

_VERSION = 5

_VERSION_WITHOUT_PARTS = 4
"""Version of files that do not tell the disconnected parts of a map apart; they are read as one part."""

_FIX = "give a file written by --save-map"

_PIXEL_TOLERANCE = 0.01
"""Maximum difference of intrinsics of the same camera, pixels: camera files differ in their number of digits."""

_DISTORTION_TOLERANCE = 1e-5
"""Maximum difference of distortion coefficients of the same camera."""


@dataclass(frozen=True)
class StoredMap:
    """Map of an earlier run.

    Attributes:
        map: Keyframes, with frame -1, and landmarks. The run to which it is given changes it.
        views: Static views of the keyframes, for dense reconstruction; can be empty.
    """

    map: SparseMap
    views: StaticViews


def save_map(path: StrPath, sparse_map: SparseMap, views: StaticViews | None = None) -> None:
    """Write a map file. Equal maps give identical files.

    Args:
        path: Path of the file, with any suffix.
        sparse_map: Keyframes and landmarks.
        views: Static views of the keyframes; None to store none, so that a later run cannot reconstruct this part of
            the map densely.

    Raises:
        InputError: If the second argument is no map.
        OutputError: If the file cannot be written.
    """
    if not isinstance(sparse_map, SparseMap):
        raise InputError(f"{path}: a {type(sparse_map).__name__} is no map; give a SparseMap, such as slam.map")
    views = StaticViews(sparse_map.camera, stride=1) if views is None else views
    about = {
        "format": MAP_FORMAT,
        "version": _VERSION,
        "camera": asdict(sparse_map.camera),
        "readout": asdict(sparse_map.readout),
        "settings": {
            "features.scale": sparse_map.features_config.scale,
            "features.levels": sparse_map.features_config.levels,
            **({"dense_map.stride": views.stride} if len(views) else {}),
        },
    }
    columns = to_columns(sparse_map, views)
    stored = {
        name: column.numpy()
        for name, column in columns.items()
        if name not in OPTIONAL_COLUMNS or bool((column != OPTIONAL_COLUMNS[name]).any())
    }
    write_array_file(Path(path), about, stored)


def load_map(path: StrPath, camera: PinholeCamera, config: Config) -> StoredMap:
    """Read a map file.

    The readout is that of the camera file, or 0 if the compensation is disabled; else the readout of the map, which is
    calibrated further. The stored features are shifted accordingly.

    Args:
        path: Path of a file written by `save_map`, of this or the previous version of the format.
        camera: Camera of the current run, which must be the camera of the map.
        config: Configuration of the current run, with the feature settings of the map.

    Raises:
        InputError: If the file is missing, not a map file, damaged, or of another version, camera or configuration.
    """
    path = Path(path)
    stored = StoredMap(SparseMap(config.mapping, config.features, camera), StaticViews(camera, config.dense_map.stride))
    with open_array_file(path, MAP_FORMAT, "a map file", _FIX) as file:
        _check_compatibility(path, file.about, camera, config)
        stored.map.readout = Readout.from_dict(file.about["readout"])
        columns = _read_columns(file, to_columns(stored.map, stored.views))
    if (problem := find_inconsistency(columns, stored.map, stored.views)) is not None:
        raise InputError(f"{path}: is a damaged map file ({problem}); {_FIX}")
    fill_from_columns(columns, stored.map, stored.views)
    own = Readout.from_camera(camera, config.rolling_shutter)
    stored.map.set_readout(stored.map.readout.for_new_run(own))
    return stored


def _read_columns(file: ArrayFile, names: Iterable[str]) -> dict[str, Tensor]:
    """Read the columns of a file, and complete those that it lacks."""
    columns: dict[str, Tensor] = {}
    for name in names:
        if name == "keyframe/part" and file.about["version"] == _VERSION_WITHOUT_PARTS:
            columns[name] = torch.from_numpy(file.read("keyframe/disconnected")).to(torch.int64)
        elif name in file or name not in OPTIONAL_COLUMNS:
            columns[name] = torch.from_numpy(file.read(name))
    for name in OPTIONAL_COLUMNS.keys() - columns.keys():
        group, default = name.split("/")[0], OPTIONAL_COLUMNS[name]
        rows = next(len(column) for other, column in columns.items() if other.startswith(f"{group}/"))
        columns[name] = default.repeat(rows, *(1,) * default.ndim)
    return columns


def _check_compatibility(path: Path, about: Mapping[str, Any], camera: PinholeCamera, config: Config) -> None:
    """Raise InputError if a map is of a different version, camera or configuration."""
    if about["version"] not in (_VERSION_WITHOUT_PARTS, _VERSION):
        raise InputError(
            f"{path}: has version {about['version']} of the map format, but this program reads versions"
            f" {_VERSION_WITHOUT_PARTS} and {_VERSION}; make the map again with --save-map, or use the program version"
            " that wrote it"
        )
    map_camera = PinholeCamera(**about["camera"])
    if not _is_same_camera(map_camera, camera):
        raise InputError(
            f"{path}: was made with another camera ({_describe(map_camera)}) than the sequence's ({_describe(camera)});"
            " give another map, or the right camera with --camera"
        )
    for key, value in about["settings"].items():
        section, name = key.split(".")
        if (own := getattr(getattr(config, section), name)) != value:
            raise InputError(f"{path}: was made with {key}={value}, not {own}; add --set {key}={value}")


def _is_same_camera(a: PinholeCamera, b: PinholeCamera) -> bool:
    """Check whether two cameras are equal up to rounding."""
    first, second = (
        np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height]) for camera in (a, b)
    )
    return (
        np.allclose(first, second, rtol=0, atol=_PIXEL_TOLERANCE)
        and a.distortion_model == b.distortion_model
        and np.allclose(a.distortion, b.distortion, rtol=0, atol=_DISTORTION_TOLERANCE)
    )


def _describe(camera: PinholeCamera) -> str:
    pinhole = f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}, {camera.width}x{camera.height}"
    lens = f"{camera.distortion_model} distortion {list(camera.distortion)}"
    return f"{pinhole}, {lens}" if camera.is_distorted else pinhole
