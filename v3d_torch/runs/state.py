"""All that the system remembers from frame to frame, named in one place: to be stored, and gone on with.

What is not named follows from the configuration, the camera and what is named. A test compares a system that goes on
from its state with one that was never stopped, attribute by attribute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from operator import attrgetter
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from v3d_torch.config import Config, TrackerConfig
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.features.orb import Features
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.paths import StrPath
from v3d_torch.io.state_file import read_state, write_state
from v3d_torch.mapping.keyframe import Keyframe, Loop
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.tensor_table import TensorTable
from v3d_torch.objects.free_space_check import DepthView
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.objects.track import Detection3D, Track
from v3d_torch.odometry.odometry import TrackedFrame
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.runtime.stage_timer import StageTimer
from v3d_torch.slam import V3DSLAM
from v3d_torch.tracking.motion_model import PosePrediction
from v3d_torch.tracking.pose_history import PoseHistory, _Entry
from v3d_torch.types import RGBDFrame, Segmenter, TrackingStatus, remind

State = dict[str, Any]
"""Values of attributes by their names, one graph: what two of them share is shared."""

OF_SLAM = (
    *("timer", "poses", "outlooks", "_memory", "_last"),
    *(f"mapper.map.{name}" for name in ("keyframes", "landmarks", "observations", "loops", "readout")),
    *("mapper._most_tracked", "mapper._untracked_since", "loop_closer.loop_count", "back_end.keyframe"),
    *(
        "free_space_check._views",
        "classify_motion._last_stamp",
        "classify_motion.tracker.tracks",
        "classify_motion.tracker._next_id",
    ),
)
"""Attributes of `V3DSLAM` and its stages. Of the places that it recognises the keyframes tell, see `refresh`."""

CLASSES: tuple[type, ...] = (
    *(
        StageTimer,
        PoseHistory,
        _Entry,
        TrackingStatus,
        PosePrediction,
        TrackedFrame,
        RGBDFrame,
        PinholeCamera,
        Features,
    ),
    *(
        Readout,
        Keyframe,
        Loop,
        TensorTable,
        DepthView,
        Track,
        Detection3D,
        ConstantVelocityKalmanFilter,
        TrackerConfig,
        set,
    ),
)
"""Of the objects in these."""


def gather(owner: object, names: Sequence[str]) -> State:
    """The values of attributes, given by their dotted names.

    Raises:
        ConfigError: there is none of that name, because a stage was replaced.
    """
    try:
        return {name: attrgetter(name)(owner) for name in names}
    except AttributeError as error:
        raise ConfigError(f"a stage that was replaced has no state that is known here ({error}); leave it") from error


def put_back(owner: object, state: Mapping[str, Any]) -> None:
    """Set the attributes that `gather` took."""
    for name, value in state.items():
        place, _, attribute = name.rpartition(".")
        setattr(attrgetter(place)(owner) if place else owner, attribute, value)


def refresh(slam: V3DSLAM) -> None:
    """Let a system whose attributes were put back follow them: what it recognises, solves and segments with."""
    newest = slam.back_end.keyframe
    for keyframe in slam.mapper.map.active_keyframes:
        if keyframe is not newest:
            slam.loop_closer.add_keyframe(keyframe)
    if newest is not None:
        slam.back_end.submit(newest)
    remind(slam.segment, slam._memory)


def save_state(path: StrPath, slam: V3DSLAM) -> None:
    """Write all that a system remembers, so that another process can go on with the next frame; see `load_state`.

    Args:
        path: of the file.
        slam: that has taken in a frame, between two frames.

    Raises:
        OutputError: when the file cannot be written.
        ConfigError: no frame has told the camera yet, or a stage was replaced by one whose state is not known.
    """
    state = gather(slam, OF_SLAM)
    about = {
        "config": slam.config.model_dump(mode="json"),
        "camera": asdict(slam.mapper.map.camera),
        "known": slam._known is not None,
    }
    write_state(Path(path), about, state)


def load_state(path: StrPath, segment: Segmenter | None = None) -> V3DSLAM:
    """The system that was written by `save_state`: with the same frames it gives the same results, to the bit.

    Args:
        path: of the file.
        segment: gives the instances of a frame; None takes what the configuration names.

    Raises:
        InputError: the file is not there, no state of a system, damaged, or of another version of this program.
        WeightsError: the network's weights are not to be had.
    """
    about, state = read_state(Path(path), CLASSES)
    try:
        config = Config.model_validate(about["config"])
        camera = PinholeCamera(**{**about["camera"], "distortion": tuple(about["camera"]["distortion"])})
        if state.keys() != set(OF_SLAM):
            raise ValueError
        known = about["known"]
    except (ValidationError, LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: is the state of something else; give a file that save_state wrote") from error
    slam = V3DSLAM(camera, segment, config, empty_map(config, camera) if known else None)
    put_back(slam, state)
    refresh(slam)
    return slam


def empty_map(config: Config, camera: PinholeCamera) -> SparseMap:
    """For a system that began in a known map, which its state has."""
    return SparseMap(config.mapping, config.features, camera)
