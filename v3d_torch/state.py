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

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import Config, IdentityConfig
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.files import StrPath
from v3d_torch.mapping.local_map import Keyframe, Loop, SparseMap
from v3d_torch.mapping.recorder import Outlook, PoseRecorder, Status, _Entry
from v3d_torch.mapping.table import Table
from v3d_torch.objects.background import DepthView
from v3d_torch.objects.motion_filter import MotionFilter
from v3d_torch.objects.track import Sighting, Track
from v3d_torch.odometry.odometry import View
from v3d_torch.odometry.orb import Features
from v3d_torch.odometry.shutter import Readout
from v3d_torch.slam import V3DSLAM
from v3d_torch.state_file import read_state, write_state
from v3d_torch.timing import StageClock
from v3d_torch.types import RGBDFrame, Segmenter, remind

State = dict[str, Any]
"""Values of attributes by their names, one graph: what two of them share is shared."""

OF_SLAM = (
    *("clock", "poses", "outlooks", "_memory", "_last"),
    *(f"mapper.map.{name}" for name in ("keyframes", "landmarks", "observations", "loops", "readout")),
    *("mapper._most_tracked", "mapper._untracked_since", "loops.count", "back_end.keyframe"),
    *("watch._views", "judge._last_stamp", "judge.tracker.tracks", "judge.tracker._next_id"),
)
"""Attributes of `V3DSLAM` and its stages. Of the places that it recognises the keyframes tell, see `refresh`."""

CLASSES: tuple[type, ...] = (
    *(StageClock, PoseRecorder, _Entry, Status, Outlook, View, RGBDFrame, PinholeCamera, Features),
    *(Readout, Keyframe, Loop, Table, DepthView, Track, Sighting, MotionFilter, IdentityConfig, set),
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
    for keyframe in slam.mapper.map.kept:
        if keyframe is not newest:
            slam.loops.learn(keyframe)
    if newest is not None:
        slam.back_end.begin(newest)
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
