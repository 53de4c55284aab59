"""Debug mode: whatever leaves a stage is looked through for numbers that are not finite, and the stage is named.

A NaN goes far before it shows: a pose that is none, a keyframe, a map. `CheckedSLAM` stops at the door that it came
through. Its results are those of `V3DSLAM`, byte by byte.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from v3d_torch.errors import NumericsError
from v3d_torch.frame_result import FrameResult, PreprocessedFrame
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import RGBDFrame

STAGES = frozenset(
    {
        *("segment", "smooth_depth", "detect_features", "register", "odometry", "free_space_check"),
        *("propose_unlabelled", "back_project_instances", "classify_motion", "map_tracker", "track_camera"),
        *("compensate_rolling_shutter", "compensate_depth_delay", "mapper", "loop_closer", "back_end"),
    }
)
"""Attributes of `V3DSLAM` that are its stages."""

MAY_BE_NAN = frozenset(
    {
        "InstanceClouds.centroid",  # of a cloud with too few points
        "NewlyOccupied.appeared",  # where it cannot be told
        "TrackedObject.centroid",  # of an object that was never well seen
        "TrackedObject.chamfer",  # that was not measured
    }
)
"""Fields in which NaN has a meaning, each said where the class is; infinite they may not be."""


def check_finite(name: str, value: object, *, nan: bool = False) -> None:
    """Look through tensors, arrays and numbers, in dataclasses, tuples, lists and dicts too.

    Args:
        name: of the value, for the message; fields and positions are put behind it.
        value: to be looked through; what is none of these is passed over.
        nan: whether NaN is allowed at the top.

    Raises:
        NumericsError: something is NaN, and not a field of `MAY_BE_NAN`, or infinite.
    """
    if isinstance(value, Tensor | np.ndarray):
        _check_tensor(name, torch.as_tensor(value), nan=nan)
    elif isinstance(value, float):
        _check_tensor(name, torch.tensor(value, dtype=torch.float64), nan=nan)
    elif is_dataclass(value) and not isinstance(value, type):
        kinds = [kind.__name__ for kind in type(value).__mro__]
        for field in fields(value):
            may = any(f"{kind}.{field.name}" in MAY_BE_NAN for kind in kinds)
            check_finite(f"{name}.{field.name}", getattr(value, field.name), nan=may)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            check_finite(f"{name}[{key!r}]", item)
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        names = getattr(value, "_fields", None)  # of a named tuple
        for index, item in enumerate(value):
            check_finite(f"{name}[{index}]" if names is None else f"{name}.{names[index]}", item)


def _check_tensor(name: str, tensor: Tensor, *, nan: bool) -> None:
    if not (tensor.is_floating_point() or tensor.is_complex()):
        return
    wrong = ~tensor.isfinite() & ~(tensor.isnan() & nan)
    count = int(wrong.sum())
    if count:
        first = tuple(torch.nonzero(wrong)[0].tolist())
        what = "NaN" if math.isnan(abs(tensor[first].item())) else "infinite"
        where = f", the first at {list(first)}" if first else ""
        raise NumericsError(f"{name} is {what}: {count} of {tensor.numel()} numbers{where}")


class CheckedStage:
    """Stands for a stage: calls it, or its methods, and checks what comes out.

    Args:
        stage: any callable.
        name: of the stage.
    """

    _OWN = ("_behind", "_sign")

    def __init__(self, stage: Any, name: str) -> None:
        self._behind = stage
        self._sign = name

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the stage.

        Raises:
            NumericsError: what it gives is not finite.
        """
        given = self._behind(*args, **kwargs)
        check_finite(self._sign, given)
        return given

    def __getattr__(self, name: str) -> Any:
        if name in self._OWN:  # asked for before there is one, as by copy
            raise AttributeError(name)
        found = getattr(self._behind, name)
        return CheckedStage(found, f"{self._sign}.{name}") if callable(found) else found

    def __setattr__(self, name: str, value: object) -> None:
        if name in self._OWN:
            super().__setattr__(name, value)
        else:
            setattr(self._behind, name, value)


class CheckedSLAM(V3DSLAM):
    """`V3DSLAM` with a door at each stage, also at those that are put in the place of one, and at both ends.

    The commands take it with ``--set check_numerics=true``. What stages keep for themselves is not looked at, but for
    the map: its poses and landmarks.
    """

    def __setattr__(self, name: str, value: object) -> None:
        super().__setattr__(name, CheckedStage(value, name) if name in STAGES else value)

    def perceive(self, frame: RGBDFrame, outlook: PosePrediction | None) -> PreprocessedFrame:
        """`V3DSLAM.preprocess`.

        Raises:
            NumericsError: the frame, or what a stage makes of it, is not finite.
        """
        with _of(frame):
            check_finite("the input", frame)
            return super().preprocess(frame, outlook)

    def take_in(self, percept: PreprocessedFrame) -> FrameResult:
        """`V3DSLAM.track`.

        Raises:
            NumericsError: what a stage gives is not finite, or the map is not after it.
        """
        with _of(percept.frame):
            tracked = super().track(percept)
            check_finite("the result", tracked)
            known = self.mapper.map
            check_finite(
                "the map", {"T_cw": known.T_cw, "landmarks": known.landmarks["point"][known.landmarks["active"]]}
            )
            return tracked


@contextmanager
def _of(frame: RGBDFrame) -> Iterator[None]:
    """Put the frame in front of the message."""
    try:
        yield
    except NumericsError as error:
        raise NumericsError(f"frame {frame.index}: {error}") from error
