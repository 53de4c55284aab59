"""A map as columns of numbers, and back: what is kept of it in a file."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from v3d_torch.features.features import Features
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.static_views import StaticView, StaticViews
from v3d_torch.mapping.tensor_table import TensorTable

Columns = Mapping[str, Tensor]
"""By group/name; the columns of a group have the same number of rows."""


def to_columns(sparse_map: SparseMap, views: StaticViews) -> dict[str, Tensor]:
    """All that a map and its views hold; of an empty map, the types and sizes that there are."""
    keyframes, features = _empty()
    for keyframe in sparse_map.keyframes:
        keyframes.append(
            stamp=torch.tensor([keyframe.stamp], dtype=torch.float64),
            T_cw=keyframe.T_cw[None],
            disconnected=torch.tensor([keyframe.disconnected]),
            reference=torch.tensor([keyframe.reference]),
            features=torch.tensor([len(keyframe.features)]),
        )
        features.append(**vars(keyframe.features), landmark=keyframe.landmarks)
    loops, size = sparse_map.loops, (views.camera.height, views.camera.width)
    units = [torch.zeros(0, *size, dtype=torch.uint16), *(view.units[None] for view in views)]
    colours = [torch.zeros(0, 3, *size, dtype=torch.uint8), *(view.colour[None] for view in views)]
    groups = {
        "keyframe": keyframes.columns,
        "feature": features.columns,
        "landmark": sparse_map.landmarks.columns,
        "observation": sparse_map.observations.columns,
        "loop": {
            "i": torch.tensor([loop.i for loop in loops], dtype=torch.int64),
            "j": torch.tensor([loop.j for loop in loops], dtype=torch.int64),
            "T_ij": torch.cat([torch.zeros(0, 4, 4, dtype=torch.float64), *(loop.T_ij[None] for loop in loops)]),
        },
        "view": {
            "keyframe": torch.tensor([view.keyframe.index for view in views], dtype=torch.int64),
            "units": torch.cat(units),
            "colour": torch.cat(colours),
        },
    }
    return {f"{group}/{name}": column for group, columns in groups.items() for name, column in columns.items()}


def from_columns(columns: Columns, sparse_map: SparseMap, views: StaticViews) -> None:
    """Fill an empty map and empty views; keyframes are of an earlier run then, their frame is -1."""
    keyframes, features, loops, seen = (_group(columns, name) for name in ("keyframe", "feature", "loop", "view"))
    ends = accumulate(keyframes["features"].tolist(), initial=0)
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
            disconnected=bool(keyframes["disconnected"][index]),
            reference=int(keyframes["reference"][index]),
        )
        sparse_map.keyframes.append(keyframe)
    sparse_map.landmarks.append(**_group(columns, "landmark"))
    sparse_map.observations.append(**_group(columns, "observation"))
    for i, j, T_ij in zip(loops["i"].tolist(), loops["j"].tolist(), loops["T_ij"], strict=True):
        sparse_map.loops.append(Loop(i, j, T_ij))
    for index, units, colour in zip(seen["keyframe"].tolist(), seen["units"], seen["colour"], strict=True):
        views.append(StaticView(sparse_map.keyframes[index], units, colour))


def find_error(columns: Columns, sparse_map: SparseMap, views: StaticViews) -> str | None:
    """What would break a run later, as far as columns can tell.

    Args:
        columns: of a file.
        sparse_map: empty, of the right camera.
        views: empty.

    Returns:
        The first thing found, None for nothing.
    """
    lengths: dict[str, int] = {}
    for name, empty in to_columns(sparse_map, views).items():
        column, group = columns[name], name.split("/")[0]
        if column.dtype != empty.dtype or (len(column) and column.shape[1:] != empty.shape[1:]):
            return f"{name} is {column.dtype} of shape {tuple(column.shape)}"
        if lengths.setdefault(group, len(column)) != len(column):
            return f"{name} has {len(column)} rows of {lengths[group]}"
        if not bool(column.isfinite().all() if column.dtype.is_floating_point else True):
            return f"{name} is not finite"
    counts, owners = columns["keyframe/features"], columns["observation/keyframe"]
    if int(counts.sum()) != lengths["feature"]:
        return "keyframe/features does not add up"
    camera, keyframes, landmarks = sparse_map.camera, lengths["keyframe"], lengths["landmark"]
    for name, least, beyond in (
        ("keyframe/features", 0, lengths["feature"] + 1),
        ("keyframe/reference", 0, keyframes),
        ("feature/pixel", 0, torch.tensor([camera.width, camera.height])),
        ("feature/landmark", -1, landmarks),
        ("landmark/keyframe", 0, keyframes),
        ("observation/landmark", 0, landmarks),
        ("observation/keyframe", 0, keyframes),
        ("observation/feature", 0, counts[owners.clamp(0, keyframes - 1)] if keyframes else 0),
        ("loop/i", 0, keyframes),
        ("loop/j", 0, keyframes),
        ("view/keyframe", 0, keyframes),
    ):
        if not bool(((columns[name] >= least) & (columns[name] < beyond)).all()):
            return f"{name} points to what is not there"
    reference = columns["keyframe/reference"]
    return None if torch.equal(reference[reference], reference) else "keyframe/reference points to what is retired"


def _empty() -> tuple[TensorTable, TensorTable]:
    """Tables of keyframes and of their features, one keyframe's after another's."""
    number, real = torch.int64, torch.float64
    keyframes = TensorTable(
        stamp=((), real),
        T_cw=((4, 4), real),
        disconnected=((), torch.bool),
        reference=((), number),
        features=((), number),
    )
    features = TensorTable(
        uv=((2,), real),
        readout_jacobian=((2,), real),
        pixel=((2,), number),
        depth=((), real),
        octave=((), number),
        descriptors=((32,), torch.uint8),
        landmark=((), number),
    )
    return keyframes, features


def _group(columns: Columns, group: str) -> dict[str, Tensor]:
    """Columns of a group by their own names."""
    return {name.removeprefix(f"{group}/"): column for name, column in columns.items() if name.startswith(f"{group}/")}
