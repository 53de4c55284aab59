"""Maps as files: all that a later run needs to find its camera in one, to go on with it and to draw it.

A file is a zip of NumPy arrays (npz) without pickled objects, so that reading one runs no code of it. Who sees what
together and the index of places are not in it: they follow from the rest.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from v3d_torch.config import Config
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.files import atomic_write
from v3d_torch.io.paths import StrPath
from v3d_torch.mapping.map_columns import find_error, from_columns, to_columns
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.odometry.rolling_shutter import Readout

_FORMAT, _VERSION = "v3d_torch map", 3

_ROOM, _RATIO = 1 << 28, 20
"""Bytes that any file may unpack to, and by how much a larger one may grow: maps grow threefold."""

_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    RuntimeError,
    MemoryError,
)
"""What zip archives, arrays and texts in them raise when bytes are wrong or missing."""


@dataclass(frozen=True)
class StoredMap:
    """A map of an earlier run.

    Attributes:
        map: keyframes, whose frame is -1, and landmarks.
        views: what keyframes saw standing still, for the coloured map; may be none.
    """

    map: SparseMap
    views: StaticViews


def save_map(path: StrPath, sparse_map: SparseMap, views: StaticViews | None = None) -> None:
    """Write a map; the same map makes the same bytes.

    Args:
        path: of the file, whatever its suffix.
        sparse_map: keyframes and landmarks.
        views: what keyframes saw standing still; without them the map cannot be drawn later.

    Raises:
        OutputError: when the file cannot be written.
    """
    views = StaticViews(sparse_map.camera, stride=1) if views is None else views
    about = {
        "format": _FORMAT,
        "version": _VERSION,
        "camera": asdict(sparse_map.camera),
        "readout": asdict(sparse_map.readout),
        "settings": {
            "features.scale": sparse_map.features.scale,
            "features.levels": sparse_map.features.levels,
            **({"dense_map.stride": views.stride} if len(views) else {}),
        },
    }
    arrays: dict[str, Any] = {name: column.numpy() for name, column in to_columns(sparse_map, views).items()}
    with atomic_write(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, about=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8), **arrays)


def load_map(path: StrPath, camera: PinholeCamera, config: Config) -> StoredMap:
    """Read a map.

    Args:
        path: of a file that `save_map` wrote.
        camera: of the frames to come, which must be the map's.
        config: of the run to come, which must look for the same features.

    Raises:
        InputError: the file is not there, no map, damaged, or of another version, camera or configuration.
    """
    path = Path(path)
    stored = StoredMap(SparseMap(config.mapping, config.features, camera), StaticViews(camera, config.dense_map.stride))
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            _refuse_bomb(archive, path.stat().st_size)
            about = json.loads(_read(archive, "about").tobytes())
            if about["format"] != _FORMAT:
                raise ValueError("it holds something else")
            _refuse_other(str(path), about, camera, config)
            stored.map.readout = Readout.from_dict(about["readout"])
            columns = {name: torch.from_numpy(_read(archive, name)) for name in to_columns(stored.map, stored.views)}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a file that --save-map wrote") from error
    except _DAMAGE as error:
        raise InputError(f"{path}: is no map, or a damaged one ({error}); give a file that --save-map wrote") from error
    if (wrong := find_error(columns, stored.map, stored.views)) is not None:
        raise InputError(f"{path}: is a damaged map ({wrong}); give a file that --save-map wrote")
    from_columns(columns, stored.map, stored.views)
    return stored


def _refuse_bomb(archive: zipfile.ZipFile, size: int) -> None:
    """Raise ValueError if the arrays take so much more than the file that it was made to fill the memory."""
    claimed = sum(member.file_size for member in archive.infolist())
    if claimed > _ROOM + _RATIO * size:
        raise ValueError(f"it claims to hold {claimed} bytes in {size}")


def _read(archive: zipfile.ZipFile, name: str) -> np.ndarray[Any, Any]:
    """An array of a file, its checksum tested."""
    return np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False)


def _refuse_other(path: str, about: Mapping[str, Any], camera: PinholeCamera, config: Config) -> None:
    """Raise an error if a map is of another version, camera or configuration."""
    if about["version"] != _VERSION:
        raise InputError(
            f"{path}: is a map in version {about['version']} of its format, of which this program knows version"
            f" {_VERSION}; read it with the program that wrote it, or make it anew"
        )
    theirs = PinholeCamera(**about["camera"])
    if not _see_the_same(theirs, camera):
        raise InputError(
            f"{path}: was made with another camera ({_said(theirs)}) than the sequence's ({_said(camera)});"
            " give another map, or the right camera with --camera"
        )
    for key, value in about["settings"].items():
        section, name = key.split(".")
        if (own := getattr(getattr(config, section), name)) != value:
            raise InputError(f"{path}: was made with {key}={value}, not {own}; add --set {key}={value}")


def _see_the_same(a: PinholeCamera, b: PinholeCamera) -> bool:
    """Whether two cameras differ by less than a hundredth of a pixel."""
    first, second = (np.array([of.fx, of.fy, of.cx, of.cy, of.width, of.height]) for of in (a, b))
    return np.allclose(first, second, rtol=0, atol=0.01) and np.allclose(a.distortion, b.distortion, rtol=0, atol=1e-5)


def _said(camera: PinholeCamera) -> str:
    pinhole = f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}, {camera.width}x{camera.height}"
    return f"{pinhole}, distortion {list(camera.distortion)}" if camera.is_distorted else pinhole
