"""Saving and loading of the state of a system, so that another process can continue with the next frame."""

from __future__ import annotations

import warnings
from dataclasses import asdict
from pathlib import Path

from pydantic import ValidationError

from v3d_torch.config import Config, StagesConfig, TrackerConfig
from v3d_torch.errors import ConfigError, InputError, StageWarning
from v3d_torch.features.features import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.paths import StrPath
from v3d_torch.io.state_file import read_state, write_state
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.objects.depth_view import StoredView
from v3d_torch.objects.feature_shift import FeatureShift
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.objects.motion_record import MotionRecord
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.range_view import RangeView
from v3d_torch.occupancy.up_direction import UpDirection
from v3d_torch.odometry.odometry import TrackedFrame
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.runtime.stage_import import first_not_given
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.runtime.tensor_table import TensorTable
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.camera_state import CameraState
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.types import RGBDFrame, Segmenter, TrackingStatus

STATE_CLASSES: tuple[type, ...] = (
    TrackedFrame, RGBDFrame, PinholeCamera, Features, PosePrediction, TrackingStatus, CameraState,
    Keyframe, Loop, TensorTable, Readout, StageTime,
    StoredView, Track, Detection3D, MotionRecord, FeatureShift, ConstantVelocityKalmanFilter, ObjectState,
    TrackerConfig, RangeView, Floor, UpDirection,
)  # fmt: skip
"""Classes of the package that a saved state can contain; others are not read."""


def save_state(path: StrPath, slam: V3DSLAM) -> None:
    """Save the state of a system between two frames, so that another process can continue; see `load_state`.

    Args:
        path: Path of the file to write.
        slam: System, between two frames.

    Raises:
        OutputError: If the file cannot be written, or the state of a replaced stage cannot be loaded again.
        ConfigError: If a stage was replaced by one without state_dict.
    """
    config = slam.config.model_dump(mode="json")
    replaced = [name for name in slam.replaced_stages if name not in slam.config.stages.paths]
    metadata = {"config": config, "camera": asdict(slam.camera), "replaced": replaced}
    write_state(Path(path), metadata, slam.state_dict(), STATE_CLASSES)


def load_state(path: StrPath, segment: Segmenter | None = None, stages: StagesConfig | None = None) -> V3DSLAM:
    """Load a system that `save_state` saved. With the same frames it gives the same results, to the bit.

    Stages that were set in Python are not in the file: set them again before the next frame. A `StageWarning` names
    them.

    Args:
        path: Path of a file written by `save_state`.
        segment: Segmenter; None to create the one named in the configuration.
        stages: Import paths of the saved configuration, ``config.stages``, if it has any; nothing is imported on the
            word of a file alone.

    Raises:
        ConfigError: If the configuration has import paths that ``stages`` does not have, or a stage cannot be made; or
            if the segmenter cannot load its state, which is that of another one.
        InputError: If the file is missing, damaged, not a saved state, or from another version.
        WeightsError: If the weights of the network are not available.
    """
    metadata, state = read_state(Path(path), STATE_CLASSES)
    try:
        config = Config.model_validate(metadata["config"])
        camera = PinholeCamera(**{**metadata["camera"], "distortion": tuple(metadata["camera"]["distortion"])})
        imported = config.stages if segment is None else config.stages.model_copy(update={"segment": None})
        if (stage := first_not_given(imported, stages or StagesConfig())) is not None:
            raise ConfigError(f"{path}: would import code, {stage}; give load_state the stages that it may import")
        slam = V3DSLAM(camera, segment, config)
        slam.load_state_dict(state)
        if replaced := metadata["replaced"]:
            message = f"{path}: the saved system had stages of its own that are not in the file: {', '.join(replaced)}"
            warnings.warn(f"{message}; set them again before the next frame", StageWarning, stacklevel=2)
    except (ValidationError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: is not the state of a system; pass a file that save_state wrote") from error
    return slam
