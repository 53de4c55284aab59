"""Cameras that are made wrong on purpose, and their calibration from a sequence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

from v3d_torch.calibration.camera_calibration import Calibration
from v3d_torch.config import Config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.runs.calibration_run import calibrate_sequence
from v3d_torch.segmentation import NoSegmentation

CHANGES: dict[str, Callable[[PinholeCamera], PinholeCamera]] = {
    "nothing": lambda camera: camera,
    "focal lengths times 1.1": lambda camera: replace(camera, fx=1.1 * camera.fx, fy=1.1 * camera.fy),
    "centre moved by (15, 15)": lambda camera: replace(camera, cx=camera.cx + 15, cy=camera.cy + 15),
}
"""Changes of a camera by their names."""


class ChangedCamera(NamedTuple):
    """A changed camera and its calibration.

    Attributes:
        change: Name of the change.
        given: Camera with which the calibration starts.
        calibration: Calibration from the sequence.
    """

    change: str
    given: PinholeCamera
    calibration: Calibration


def calibrate_changed_cameras(
    source: str, config: Config, select: Callable[[RGBDSequence], RGBDSequence] = lambda sequence: sequence
) -> Iterator[ChangedCamera]:
    """Change the camera of a sequence in each way of `CHANGES`, and calibrate it.

    Args:
        source: Sequence as `load_sequence` takes it.
        config: Configuration.
        select: Returns the frames to calibrate on.

    Raises:
        V3DError: If the sequence is missing or damaged.
    """

    def open_sequence(camera: PinholeCamera) -> RGBDSequence:
        return select(load_sequence(source, camera=camera))

    right = load_sequence(source).camera
    for name, change in CHANGES.items():
        given = change(right)
        calibration = calibrate_sequence(
            open_sequence(given), open_sequence, lambda _: NoSegmentation(), config, lambda *_: lambda *_: None
        )
        yield ChangedCamera(name, given, calibration)
