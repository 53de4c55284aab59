"""Calibration of the camera of a sequence: runs are repeated with the calibrated camera until it converges."""

from __future__ import annotations

from collections.abc import Callable

from v3d_torch.calibration.camera_calibration import Calibration, calibrate_camera
from v3d_torch.config import Config
from v3d_torch.datasets.base import RGBDSequence
from v3d_torch.errors import RunError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.pipeline import FrameCallback, Pipeline
from v3d_torch.runs.system import check_map_is_given, make_system
from v3d_torch.types import Segmenter

_MAX_RUNS = 4
"""Maximum number of runs. With a wrong focal length matches are missing; the next run with a better one finds more."""

_CONVERGED = 0.5
"""Maximum change of an estimate between two runs at convergence, in standard deviations."""

_MIN_PIXEL_SIGMA = 1.0
"""Minimum standard deviation of the position of a feature in the runs, pixels: a wrong camera adds to the errors, and
with a smaller one the landmarks that show how it is wrong would be outliers."""


def calibrate_sequence(
    sequence: RGBDSequence,
    reopen: Callable[[PinholeCamera], RGBDSequence],
    make_segmenter: Callable[[PinholeCamera], Segmenter],
    config: Config,
    on_run: Callable[[int, int], FrameCallback],
) -> Calibration:
    """Calibrate the camera of a sequence.

    Args:
        sequence: Sequence with the given camera.
        reopen: Function that opens the sequence with another camera.
        make_segmenter: Function that makes the segmenter of a run with this camera.
        config: Configuration. The runs raise ``tracking.pixel_sigma`` to at least a pixel, and each later run has the
            next seed.
        on_run: Called before each run with its number, from 1, and the number of frames; returns a function that is
            called after each frame.

    Raises:
        RunError: If a frame cannot be read.
        ConfigError: If the configuration does not map, or as `make_segmenter` raises it.
    """
    check_map_is_given(config)
    given = camera = sequence.camera
    previous: Calibration | None = None
    for number in range(1, _MAX_RUNS + 1):
        config_of_run = _config_of_run(config, number)
        slam = make_system(camera, make_segmenter(camera), config_of_run)
        pipeline = Pipeline(sequence, slam, evaluate_masks=False)
        record = pipeline(on_run(number, len(sequence)))
        if record.failure is not None:
            raise RunError(record.failure)
        pipeline.flush()
        calibration = calibrate_camera(
            pipeline.slam.map,
            pipeline.views,
            pipeline.slam.poses.trajectory(),
            sequence.groundtruth,
            camera,
            given,
            config_of_run,
        )
        if number == _MAX_RUNS or _is_converged(calibration, camera, previous):
            break
        previous, camera = calibration, calibration.next_camera
        sequence = reopen(camera)
    return calibration


def _config_of_run(config: Config, number: int) -> Config:
    """Return the configuration of a run, by its number from 1: with other random samples than in the runs before."""
    sigma = max(config.tracking.pixel_sigma, _MIN_PIXEL_SIGMA)
    tracking = config.tracking.model_copy(update={"pixel_sigma": sigma})
    return config.model_copy(update={"tracking": tracking, "seed": config.seed + number - 1})


def _is_converged(calibration: Calibration, camera: PinholeCamera, previous: Calibration | None) -> bool:
    """Check whether the last two runs gave the same values, up to a fraction of their uncertainty.

    Args:
        calibration: Calibration from the last run.
        camera: Camera of the last run.
        previous: Calibration from the run before; None after the first run.
    """
    accepted, before = calibration.accepted, {} if previous is None else previous.accepted
    if "fx" not in accepted and (previous is None or calibration.next_camera.fx != camera.fx):
        return False  # other focal lengths explain the images better, or other random samples could show them
    return accepted.keys() == before.keys() and all(
        abs(each.value - before[name].value) <= _CONVERGED * each.sigma for name, each in accepted.items()
    )
