"""Objects of one frame with their motion states, and the static mask."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

from v3d_torch.objects.object_state import ObjectState
from v3d_torch.objects.upright_box import UprightBox, upright_boxes
from v3d_torch.segmentation.coco import class_name


class MotionState(StrEnum):
    """Motion state of an object."""

    STATIC = "static"
    """At rest: camera tracking, landmarks and the occupancy map use its pixels. Point map and mesh use them unless it
    is a person."""
    DYNAMIC = "dynamic"
    """It moved recently: most of it is where an earlier view saw free space, or most of its former place is free now
    and enough objects vote for it, or its features moved against the camera motion."""
    DEFORMING = "deforming"
    """A person or animal that changes its shape in place, by the Chamfer distance."""
    UNKNOWN = "unknown"
    """Not decided yet: its pixels are not tracked."""


@dataclass(frozen=True)
class TrackedObject:
    """Object of one frame with its motion state.

    Attributes:
        id: Number of the object.
        label: COCO class index; see `name` for the class name.
        mask: Pixels of the object, bool, shape :math:`(H, W)`: the mask of the network, refined by depth if the object
            is a person or not static. A predicted mask leaves out the surfaces of detected objects of the class. It is
            empty if these cover most of it, or if the object is hidden, not confirmed, or missed for more than 0.1 s,
            because later predictions are seldom right. ``static_mask`` of `FrameObjects` still excludes all predicted
            pixels.
        state: Position of the visible part and velocity, with their covariance, at the time of the frame. The position
            is the centroid of the surface in a refined mask, otherwise that of the cloud.
        history: States of the last 10 s, at most one in 0.1 s, oldest first.
        votes: Number of votes in this frame, maximum over the time spans; the free-space check has one vote.
        chamfer: Root-mean-square nearest-neighbour distance to the earlier cloud, metres; NaN if it was not measured,
            for example because the object is dynamic.
        motion_state: Static, dynamic, deforming or unknown.
        missed: True if the network did not detect the object in this frame, so that mask and centroid are predicted.
        cloud: Point cloud of the last detection, world frame, metres, float32, shape :math:`(P, 3)`; that of a missed
            object moves with its prediction.
    """

    id: int
    label: int
    mask: Tensor
    state: ObjectState
    history: tuple[ObjectState, ...]
    votes: int
    chamfer: float
    motion_state: MotionState
    missed: bool
    cloud: Tensor

    @property
    def centroid(self) -> Tensor:
        """Centroid of the visible part, world frame, metres, float64, shape :math:`(3,)`; NaN if unknown."""
        return self.state.position

    @property
    def name(self) -> str:
        """Class name and id, for example ``person 3``."""
        return f"{class_name(self.label)} {self.id}"


@dataclass(frozen=True)
class FrameObjects:
    """Objects of one frame and the pixels that show the static scene.

    Attributes:
        objects: Objects, sorted by id.
        static_mask: Pixels that camera tracking can use, bool, shape :math:`(H, W)`.
        map_mask: Pixels of ``static_mask`` at a larger distance from excluded objects and from people, even
            static ones: for what is stored, such as point map, recordings and static surfaces; bool, shape
            :math:`(H, W)`.
        vote_pairs: Votes that counted over any time span: id of the voting object and id of the object voted for,
            sorted.
    """

    objects: list[TrackedObject]
    static_mask: Tensor
    map_mask: Tensor
    vote_pairs: list[tuple[int, int]]

    @classmethod
    def empty(cls, height: int, width: int) -> FrameObjects:
        """Return the result for a frame in which everything is static."""
        everywhere = torch.ones(height, width, dtype=torch.bool)
        return cls([], everywhere, everywhere, [])

    def boxes(self, up: Tensor) -> dict[int, UprightBox]:
        """Compute the upright box of each object that has a cloud and a centroid, by id.

        Args:
            up: Direction against gravity, world frame, shape :math:`(3,)`, such as `V3DSLAM.up`.
        """
        with_centroid = [each for each in self.objects if len(each.cloud) and each.state.is_known]
        clouds = [each.cloud for each in with_centroid]
        boxes = upright_boxes(clouds, up, [each.state.velocity for each in with_centroid])
        return {each.id: box for each, box in zip(with_centroid, boxes, strict=True)}
