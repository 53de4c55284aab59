"""A whole sequence through the system, with everything that the results need noted on the way."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.datasets.base import RGBDSequence
from v3d_torch.errors import V3DError
from v3d_torch.files import write_png
from v3d_torch.mapping.dense import DenseMap
from v3d_torch.mapping.recorder import Status
from v3d_torch.objects.dynamics import Judged, Scene
from v3d_torch.segmentation.coco import COCO_NAMES
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame

FrameCallback = Callable[[RGBDFrame, Scene, Status], None]


@dataclass(frozen=True)
class Snapshot:
    """A frame kept for the figure of masks."""

    stamp: float
    image: Tensor
    objects: list[Judged]


@dataclass
class Run:
    """What a run leaves behind beside the trajectory.

    Attributes:
        dynamics: a row per frame and object, as it goes into the table of the results.
        snapshots: frames for the figure of masks.
        seconds: wall time of the frames.
        failure: why the run ended before the sequence did; None when it did not.
    """

    dynamics: list[dict[str, object]] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    seconds: float = 0.0
    failure: str | None = None


class Pipeline:
    """Runs a sequence through the system.

    Args:
        sequence: frames to take in.
        slam: the system, new.
        masks: folder for an image per frame of what was left out of tracking; None for none.
    """

    _SNAPSHOTS = 6

    def __init__(self, sequence: RGBDSequence, slam: V3DSLAM, masks: Path | None = None) -> None:
        self.sequence = sequence
        self.slam = slam
        self.dense = DenseMap(slam.config.dense_map, sequence.camera)
        self.run = Run()
        self._masks = masks

    def __call__(self, on_frame: FrameCallback | None = None) -> Run:
        """Process all frames. What was computed is kept when a frame cannot be read or the user interrupts.

        Args:
            on_frame: called after each frame.
        """
        start = time.perf_counter()
        try:
            for index in range(len(self.sequence)):
                with self.slam.clock("read"):
                    frame = self.sequence[index]
                scene = self.slam(frame)
                self._note(frame, scene)
                if on_frame is not None:
                    on_frame(frame, scene, self.slam.poses.statuses[-1])
        except V3DError as error:
            self.run.failure = str(error)
        except KeyboardInterrupt:
            done, total = len(self.slam.poses.statuses), len(self.sequence)
            self.run.failure = f"interrupted after {done} of {total} frames"
        self.run.seconds = time.perf_counter() - start
        return self.run

    def _note(self, frame: RGBDFrame, scene: Scene) -> None:
        self.run.dynamics.extend(_row(frame, judged) for judged in scene.objects)
        if self._masks is not None:
            left_out = (~scene.static).to(torch.uint8) * 255
            write_png(self._masks / f"{frame.stamp:.6f}.png", left_out.numpy())
        keyframes = self.slam.mapper.map.keyframes
        if keyframes and keyframes[-1].frame == frame.index:
            self.dense.add(keyframes[-1], frame.image, frame.depth, scene.unpeopled)
        step = max(len(self.sequence) // self._SNAPSHOTS, 1)
        if frame.index % step == step // 2 and len(self.run.snapshots) < self._SNAPSHOTS:
            self.run.snapshots.append(Snapshot(frame.stamp, frame.image, scene.objects))


def _row(frame: RGBDFrame, judged: Judged) -> dict[str, object]:
    x, y, z = judged.centroid.tolist()
    return {
        "frame": frame.index,
        "stamp": frame.stamp,
        "id": judged.id,
        "class": COCO_NAMES[judged.label],
        "x": x,
        "y": y,
        "z": z,
        "votes": judged.votes,
        "chamfer": judged.chamfer,
        "verdict": judged.verdict.value,
        "missed": judged.missed,
    }
