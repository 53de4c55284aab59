"""Debug mode: the results of every stage are checked for NaN and infinity, and the error names the first such stage.

A NaN spreads before it becomes visible, from a pose to a keyframe to the map. `CheckedSLAM` stops at the stage that
returned it. Without NaN, its results are byte-identical to those of `V3DSLAM`.
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
from v3d_torch.frame_result import Extraction, FrameResult, PreprocessedFrame, Segmentation
from v3d_torch.runtime.stage_proxy import STATE_METHODS, CheckingProxy
from v3d_torch.slam import V3DSLAM
from v3d_torch.stages.replaceable_stages import INNER_STAGES
from v3d_torch.stages.stage_checks import RESULTS
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import RGBDFrame

_CHECKED = {"segment", *RESULTS, *INNER_STAGES}
"""Names of the stages whose results are checked. The map is checked after each frame."""

MAY_BE_NAN = frozenset(
    {
        "InstanceClouds.centroid",  # of a cloud with too few points
        "AppearedPixels.was_free",  # if it is not known
        "ObjectState.position",  # of an object that never had a clean cloud
        "TrackedObject.chamfer",  # if it was not measured
        "describe_appearance",  # of an instance with too few pixels
    }
)
"""Fields, and results of stages, in which NaN has a meaning, which the class of the field or the protocol of the stage
documents."""

MAY_BE_INFINITE = frozenset({"Readout.information"})  # of a readout that the camera states
"""Fields in which infinity has a meaning, which their class documents."""


def check_finite(name: str, value: object, *, nan: bool = False, infinite: bool = False) -> None:
    """Check tensors, arrays and numbers, also in dataclasses, sequences and mappings.

    Args:
        name: Name of the value in the message; names of fields and positions are appended.
        value: Value to check; values of other types are ignored.
        nan: True to allow NaN in the value itself.
        infinite: True to allow infinity in the value itself.

    Raises:
        NumericsError: If a number is NaN outside of the fields in `MAY_BE_NAN`, or infinite outside of those in
            `MAY_BE_INFINITE`.
    """
    if isinstance(value, Tensor | np.ndarray):
        _check_tensor(name, torch.as_tensor(value), nan=nan, infinite=infinite)
    elif isinstance(value, float):
        _check_tensor(name, torch.tensor(value, dtype=torch.float64), nan=nan, infinite=infinite)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            names = {f"{cls.__name__}.{field.name}" for cls in type(value).__mro__}
            nan, infinite = not names.isdisjoint(MAY_BE_NAN), not names.isdisjoint(MAY_BE_INFINITE)
            check_finite(f"{name}.{field.name}", getattr(value, field.name), nan=nan, infinite=infinite)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            check_finite(f"{name}[{key!r}]", item)
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        keys = getattr(value, "_fields", None)  # of a named tuple
        for index, item in enumerate(value):
            check_finite(f"{name}[{index}]" if keys is None else f"{name}.{keys[index]}", item)


def _check_tensor(name: str, tensor: Tensor, *, nan: bool, infinite: bool) -> None:
    if not (tensor.is_floating_point() or tensor.is_complex()):
        return
    wrong = ~tensor.isfinite() & ~(tensor.isnan() & nan) & ~(tensor.isinf() & infinite)
    count = int(wrong.sum())
    if count:
        first = tuple(torch.nonzero(wrong)[0].tolist())
        kind = "NaN" if math.isnan(abs(tensor[first].item())) else "infinite"
        position = f", the first at {list(first)}" if first else ""
        raise NumericsError(f"{name} is {kind}: {count} of {tensor.numel()} numbers{position}")


class CheckedStage(CheckingProxy):
    """Proxy of a stage that checks the results of its call and of its methods.

    Args:
        stage: Stage.
        name: Name of the stage in messages.

    Raises:
        NumericsError: When the stage or a method is called, if the result is not finite.
    """

    def _check(self, result: Any, *args: Any) -> None:
        check_finite(self._name, result, nan=self._name in MAY_BE_NAN)

    def __getattr__(self, name: str) -> Any:
        value = super().__getattr__(name)
        # NaN has a meaning in some of the fields of a state.
        is_checked = callable(value) and name not in STATE_METHODS
        return CheckedStage(value, f"{self._name}.{name}") if is_checked else value


class CheckedSLAM(V3DSLAM):
    """`V3DSLAM` that checks the frames, the results of all stages, also of replaced ones, and the map.

    The commands use it with ``--set check_numerics=true``.
    """

    def __setattr__(self, name: str, value: object) -> None:
        super().__setattr__(name, CheckedStage(value, name) if name in _CHECKED else value)

    def check(self, frame: RGBDFrame) -> None:
        """Run `V3DSLAM.check`.

        Raises:
            NumericsError: If the frame is not finite.
        """
        with _frame_in_message(frame):
            check_finite("the input", frame)
        super().check(frame)

    def segment_instances(
        self, frame: RGBDFrame, prediction: PosePrediction | None, is_due: bool | None = None
    ) -> Segmentation:
        """Run `V3DSLAM.segment_instances`.

        Raises:
            NumericsError: If the result of the segmenter is not finite.
        """
        with _frame_in_message(frame):
            return super().segment_instances(frame, prediction, is_due)

    def extract_features(self, frame: RGBDFrame) -> Extraction:
        """Run `V3DSLAM.extract_features`.

        Raises:
            NumericsError: If the result of a stage is not finite.
        """
        with _frame_in_message(frame):
            return super().extract_features(frame)

    def track(self, preprocessed: PreprocessedFrame) -> FrameResult:
        """Run `V3DSLAM.track`.

        Raises:
            NumericsError: If the result of a stage, or the map, is not finite.
        """
        with _frame_in_message(preprocessed.frame):
            result = super().track(preprocessed)
            check_finite("the result", result)
            landmarks = self.map.landmarks
            check_finite("the map", {"T_cw": self.map.T_cw, "landmarks": landmarks["point"][landmarks["active"]]})
            return result


@contextmanager
def _frame_in_message(frame: RGBDFrame) -> Iterator[None]:
    """Prepend the index of the frame to error messages."""
    try:
        yield
    except NumericsError as error:
        raise NumericsError(f"frame {frame.index}: {error}") from error
