"""The up direction and the level frame as they are known during a run."""

from __future__ import annotations

from torch import Tensor

from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.up_direction import UpDirection, estimate_up
from v3d_torch.runtime.stateful import StatefulComponent


class UpEstimator(StatefulComponent):
    """Collects the measurements of the up direction: measured gravity, and votes of the segmentation.

    Attributes:
        gravity: First measured direction of gravity, a unit vector in the world frame, float64, shape :math:`(3,)`;
            None before.
        votes: Sum of the votes of the segmentation, see `UprightSegmenter.up_votes`; None if there are none.
    """

    _STATE = ("gravity", "votes")

    def __init__(self) -> None:
        self.gravity: Tensor | None = None
        self.votes: Tensor | None = None

    def add_gravity(self, gravity: Tensor | None, T_cw: Tensor, T_new_old: Tensor | None) -> None:
        """Rotate the stored gravity if the camera has been found in another world frame, or store the first one.

        Corrections of the back end do not rotate it: they keep the first camera in its place.

        Args:
            gravity: Direction of gravity in the frame, camera frame, shape :math:`(3,)`; None if it is not measured.
            T_cw: Pose of the camera, new world to camera, shape :math:`(4, 4)`.
            T_new_old: Transform from the old to the new world frame, shape :math:`(4, 4)`; None if it is the same.
        """
        if self.gravity is None:
            self.gravity = None if gravity is None else T_cw[:3, :3].T @ gravity
        elif T_new_old is not None:
            self.gravity = T_new_old[:3, :3] @ self.gravity

    def estimate(self) -> UpDirection:
        """Estimate the up direction from gravity, else from votes, else from the first camera, see `estimate_up`."""
        return estimate_up(self.gravity, self.votes)

    def up(self, floor: Floor | None) -> Tensor:
        """Return the up direction; the normal of the floor replaces an estimate without gravity.

        Args:
            floor: Floor, if it is known.

        Returns:
            Unit vector, world frame, float64, shape :math:`(3,)`.
        """
        return floor.up if floor is not None and self.gravity is None else self.estimate().direction

    def T_lw(self, floor: Floor | None) -> Tensor | None:
        """Return the transform from the world to the level frame; None if neither gravity nor floor is known.

        Args:
            floor: Floor, if it is known.

        Returns:
            Transform, float64, shape :math:`(4, 4)`, see `level_frame`.
        """
        return None if floor is None and self.gravity is None else level_frame(self.up(floor))
