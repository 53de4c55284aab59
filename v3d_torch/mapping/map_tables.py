"""Data of the sparse map: keyframes, landmarks, observations and loops."""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.mapping.keyframe import Keyframe, Loop, stack_poses
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout
from v3d_torch.runtime.stateful import StatefulComponent
from v3d_torch.runtime.tensor_table import TensorTable


class MapTables(StatefulComponent):
    """Keyframes, landmarks and observations of a sparse map, without operations that need a camera.

    A landmark id is a row of ``landmarks``.

    Attributes:
        keyframes: All keyframes, also culled ones, in order of their index.
        landmarks: Table of landmarks.

            - ``point``: Position, world frame, metres, float64, :math:`(3,)`.
            - ``direction``: Unit viewing direction from the keyframe that created the landmark, world frame,
              float64, :math:`(3,)`.
            - ``reference_distance``: Distance at which the landmark appears at octave 0, metres, float64.
            - ``descriptor``: ORB descriptor, uint8, :math:`(32,)`.
            - ``keyframe``: Index of the keyframe that created the landmark, int64. The landmark moves with it.
            - ``found``: Number of frames that matched the landmark, int64.
            - ``visible``: Number of frames that should have matched the landmark, int64.
            - ``active``: False once the landmark is culled or merged into another one, bool.
        observations: Table of observations of landmarks by keyframes.

            - ``keyframe``: Index of the keyframe, int64.
            - ``landmark``: Id of the landmark, int64.
            - ``feature``: Index of the feature in the keyframe, int64.
            - ``uv``: Undistorted pixel, float64, :math:`(2,)`.
            - ``readout_jacobian``: Derivative of ``uv`` with respect to the readout, pixels/s, float64, :math:`(2,)`.
            - ``inverse_depth``: 1/m, float64; 0 without a depth measurement.
            - ``octave``: Octave, see `Features`, int64.
            - ``sigma_ratio``: Relative standard deviations of pixel and inverse depth, see `Features`, float64,
              :math:`(2,)`.
            - ``valid``: False once the observation is removed as an outlier, bool.
        loops: Closed loops, oldest first.
        readout: Readout of the camera with which the stored features were compensated.
    """

    _STATE = ("keyframes", "landmarks", "observations", "loops", "readout")

    def __init__(self) -> None:
        self.keyframes: list[Keyframe] = []
        self.landmarks = TensorTable(
            point=((3,), torch.float64),
            direction=((3,), torch.float64),
            reference_distance=((), torch.float64),
            descriptor=((32,), torch.uint8),
            keyframe=((), torch.int64),
            found=((), torch.int64),
            visible=((), torch.int64),
            active=((), torch.bool),
        )
        self.observations = TensorTable(
            keyframe=((), torch.int64),
            landmark=((), torch.int64),
            feature=((), torch.int64),
            uv=((2,), torch.float64),
            readout_jacobian=((2,), torch.float64),
            inverse_depth=((), torch.float64),
            octave=((), torch.int64),
            sigma_ratio=((2,), torch.float64),
            valid=((), torch.bool),
        )
        self.loops: list[Loop] = []
        self.readout: Readout = GLOBAL_SHUTTER

    @property
    def active_keyframes(self) -> list[Keyframe]:
        """Keyframes that are not culled."""
        return [keyframe for keyframe in self.keyframes if not keyframe.is_culled]

    @property
    def own_keyframes(self) -> list[Keyframe]:
        """Active keyframes of this run, without those of an earlier run."""
        return [keyframe for keyframe in self.active_keyframes if not keyframe.is_from_earlier_run]

    @property
    def T_cw(self) -> Tensor:
        """World-to-camera poses of all keyframes, also culled ones, float64, shape :math:`(K, 4, 4)`; K can be 0."""
        return stack_poses(self.keyframes)

    @property
    def references(self) -> Tensor:
        """Index of the reference keyframe of each keyframe, int64, shape :math:`(K,)`."""
        return torch.tensor([keyframe.reference for keyframe in self.keyframes], dtype=torch.int64)

    @property
    def unused_part(self) -> int:
        """Id of a part without keyframes, see `Keyframe`; not 0, which is the part where the map starts."""
        return max((keyframe.part for keyframe in self.keyframes), default=0) + 1

    def newest_keyframe_at(self, stamp: float) -> Keyframe | None:
        """Return the newest keyframe if it was created from the frame at a time; None otherwise.

        Times identify frames: they increase, whereas the indices of a camera begin again when it is started again.

        Args:
            stamp: Timestamp of the newest frame, or of the one before, seconds.
        """
        newest = self.keyframes[-1] if self.keyframes else None
        is_at = newest is not None and newest.stamp == stamp and not newest.is_from_earlier_run
        return newest if is_at else None

    def join_parts(self, a: int, b: int) -> None:
        """Join two parts, see `Keyframe`, in place; the joined part has the lower of both ids.

        Args:
            a: Id of a part.
            b: Id of a part; if it is the same, nothing changes.
        """
        for keyframe in self.keyframes:
            if keyframe.part == max(a, b):
                keyframe.part = min(a, b)
