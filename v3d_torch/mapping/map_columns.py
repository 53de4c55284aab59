"""Conversion of a map and its static views to named columns, and back; the content of a map file."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.features.scale_pyramid import octaves_of_levels
from v3d_torch.geometry.se3 import are_rigid
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.mapping.landmark_ids import compacted_ids, find_landmarks_in_use
from v3d_torch.mapping.map_tables import MapTables
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.static_views import StaticView, StaticViews
from v3d_torch.runtime.tensor_table import TensorTable

Columns = Mapping[str, Tensor]
"""Columns by ``group/name``. The columns of one group have the same number of rows."""

OPTIONAL_COLUMNS: Columns = {
    "feature/sigma_ratio": torch.ones(2, dtype=torch.float64),
    "observation/sigma_ratio": torch.ones(2, dtype=torch.float64),
    "view/T_dc": torch.eye(4, dtype=torch.float64),
}
"""Default row of each optional column. A column without other rows is not stored, and is completed by this row."""

_MIN_SIGMA_RATIO = torch.finfo(torch.float64).tiny
"""Smallest positive number: standard deviations are not zero."""

_ROTATION_TOLERANCE = 5e-7
"""Maximum difference between an element of R R^T and of the identity: rotations are stored in float64."""


def to_columns(tables: MapTables, views: StaticViews) -> dict[str, Tensor]:
    """Convert a map and its views to columns. An empty map gives empty columns of the right type and shape.

    Landmarks that are not in use are left out; the ids of the others are their rows in the columns.

    Args:
        tables: Data of the map.
        views: Static views of its keyframes.
    """
    keyframes, features = _empty_tables()
    in_use = find_landmarks_in_use(tables)
    new_id = compacted_ids(in_use)
    for keyframe in tables.keyframes:
        keyframes.append(
            stamp=torch.tensor([keyframe.stamp], dtype=torch.float64),
            T_cw=keyframe.T_cw[None],
            part=torch.tensor([keyframe.part]),
            reference=torch.tensor([keyframe.reference]),
            feature_count=torch.tensor([len(keyframe.features)]),
        )
        features.append(**vars(keyframe.features), landmark=new_id[keyframe.landmarks])
    loops, size = tables.loops, (views.camera.height, views.camera.width)
    depth_units = [torch.zeros(0, *size, dtype=torch.uint16), *(view.depth_units[None] for view in views)]
    colours = [torch.zeros(0, 3, *size, dtype=torch.uint8), *(view.colour[None] for view in views)]
    groups = {
        "keyframe": keyframes.columns,
        "feature": features.columns,
        "landmark": {name: column[in_use] for name, column in tables.landmarks.columns.items()},
        "observation": tables.observations.columns | {"landmark": new_id[tables.observations["landmark"]]},
        "loop": {
            "i": torch.tensor([loop.i for loop in loops], dtype=torch.int64),
            "j": torch.tensor([loop.j for loop in loops], dtype=torch.int64),
            "T_ij": torch.cat([torch.zeros(0, 4, 4, dtype=torch.float64), *(loop.T_ij[None] for loop in loops)]),
        },
        "view": {
            "keyframe": torch.tensor([view.keyframe.index for view in views], dtype=torch.int64),
            "depth_units": torch.cat(depth_units),
            "colour": torch.cat(colours),
            "T_dc": torch.cat([torch.zeros(0, 4, 4, dtype=torch.float64), *(view.T_dc[None] for view in views)]),
        },
    }
    return {f"{group}/{name}": column for group, columns in groups.items() for name, column in columns.items()}


def fill_from_columns(columns: Columns, tables: MapTables, views: StaticViews) -> None:
    """Fill an empty map and empty views, in place. The keyframes are marked as from an earlier run (frame -1).

    Args:
        columns: Columns without inconsistencies, see `find_inconsistency`.
        tables: Empty map.
        views: Empty views.
    """
    keyframes, features = _select_group(columns, "keyframe"), _select_group(columns, "feature")
    ends = accumulate(keyframes["feature_count"].tolist(), initial=0)
    for index, (first, last) in enumerate(pairwise(ends)):
        own = {name: column[first:last] for name, column in features.items()}
        landmarks = own.pop("landmark")
        keyframe = Keyframe(
            index=index,
            frame=-1,
            stamp=keyframes["stamp"][index].item(),
            T_cw=keyframes["T_cw"][index],
            features=Features(**own),
            landmarks=landmarks,
            part=int(keyframes["part"][index]),
            reference=int(keyframes["reference"][index]),
        )
        tables.keyframes.append(keyframe)
    tables.landmarks.append(**_select_group(columns, "landmark"))
    tables.observations.append(**_select_group(columns, "observation"))
    loops, stored = _select_group(columns, "loop"), _select_group(columns, "view")
    for i, j, T_ij in zip(loops["i"].tolist(), loops["j"].tolist(), loops["T_ij"], strict=True):
        tables.loops.append(Loop(i, j, T_ij))
    images = stored["depth_units"], stored["colour"], stored["T_dc"]
    for index, units, colour, T_dc in zip(stored["keyframe"].tolist(), *images, strict=True):
        views.append(StaticView(tables.keyframes[index], units, colour, T_dc))


def find_inconsistency(columns: Columns, sparse_map: SparseMap, views: StaticViews) -> str | None:
    """Find a type, shape, value or index in columns that would make a later run fail.

    Args:
        columns: Columns of a file.
        sparse_map: Empty map with the camera of the file.
        views: Empty views with the camera of the file.

    Returns:
        Description of the first inconsistency, or None.
    """
    lengths: dict[str, int] = {}
    for name, empty in to_columns(sparse_map, views).items():
        column, group = columns[name], name.split("/")[0]
        if column.dtype != empty.dtype or (len(column) and column.shape[1:] != empty.shape[1:]):
            return f"{name} has dtype {column.dtype} and shape {tuple(column.shape)}"
        if lengths.setdefault(group, len(column)) != len(column):
            return f"{name} has {len(column)} rows instead of {lengths[group]}"
        if not bool(column.isfinite().all() if column.dtype.is_floating_point else True):
            return f"{name} is not finite"
    counts, owners = columns["keyframe/feature_count"], columns["observation/keyframe"]
    if int(counts.sum()) != lengths["feature"]:
        return "keyframe/feature_count does not add up to the number of features"
    camera, keyframes, landmarks = sparse_map.camera, lengths["keyframe"], lengths["landmark"]
    octaves = octaves_of_levels(sparse_map.features_config, camera.width)
    for name, minimum, end in (
        ("keyframe/part", 0, keyframes),
        ("keyframe/feature_count", 0, lengths["feature"] + 1),
        ("keyframe/reference", 0, keyframes),
        ("feature/pixel", 0, torch.tensor([camera.width, camera.height])),
        ("feature/octave", octaves.start, octaves.stop),
        ("feature/landmark", -1, landmarks),
        ("landmark/keyframe", 0, keyframes),
        ("observation/landmark", 0, landmarks),
        ("observation/keyframe", 0, keyframes),
        ("observation/feature", 0, counts[owners.clamp(0, keyframes - 1)] if keyframes else 0),
        ("observation/octave", octaves.start, octaves.stop),
        ("feature/sigma_ratio", _MIN_SIGMA_RATIO, torch.inf),
        ("observation/sigma_ratio", _MIN_SIGMA_RATIO, torch.inf),
        ("loop/i", 0, keyframes),
        ("loop/j", 0, keyframes),
        ("view/keyframe", 0, keyframes),
    ):
        if not bool(((columns[name] >= minimum) & (columns[name] < end)).all()):
            return f"{name} has values out of range"
    for name in ("keyframe/T_cw", "loop/T_ij", "view/T_dc"):
        if not bool(are_rigid(columns[name], _ROTATION_TOLERANCE).all()):
            return f"{name} has matrices that are not rigid motions"
    reference = columns["keyframe/reference"]
    return None if torch.equal(reference[reference], reference) else "keyframe/reference refers to a culled keyframe"


def _empty_tables() -> tuple[TensorTable, TensorTable]:
    """Tables of keyframes, and of the features of all keyframes in the order of the keyframes."""
    keyframes = TensorTable(
        stamp=((), torch.float64),
        T_cw=((4, 4), torch.float64),
        part=((), torch.int64),
        reference=((), torch.int64),
        feature_count=((), torch.int64),
    )
    features = TensorTable(
        uv=((2,), torch.float64),
        readout_jacobian=((2,), torch.float64),
        pixel=((2,), torch.int64),
        depth=((), torch.float64),
        octave=((), torch.int64),
        sigma_ratio=((2,), torch.float64),
        descriptors=((32,), torch.uint8),
        landmark=((), torch.int64),
    )
    return keyframes, features


def _select_group(columns: Columns, group: str) -> dict[str, Tensor]:
    """Columns of a group, by name without the group."""
    return {name.removeprefix(f"{group}/"): column for name, column in columns.items() if name.startswith(f"{group}/")}
