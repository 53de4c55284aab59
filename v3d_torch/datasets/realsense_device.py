"""RealSense cameras and recordings as librealsense's pipeline runs them."""

from __future__ import annotations

from pathlib import Path
from threading import Thread
from typing import Any, Protocol

from v3d_torch.datasets.realsense_camera import library
from v3d_torch.errors import InputError

_SIZE = (640, 480)
"""Of both images of a live camera: what is tuned in this project is tuned at this."""
_FPS = 30
"""Frames a second of a live camera, unless the user says otherwise: the most that its depth and colour both have."""


class Device(Protocol):
    """What gives sets of a colour and a depth image, once it is started.

    Attributes:
        intrinsics: librealsense's, of the colour images.
        depth_unit: metres.
    """

    intrinsics: Any
    depth_unit: float

    def start(self) -> None:
        """Let the streams run, from the beginning."""

    def wait(self, milliseconds: int) -> Any | None:
        """The next set of frames, None where none came in time."""

    def is_over(self) -> bool:
        """Whether nothing will come any more."""

    def stop(self) -> None:
        """Let go of the camera."""


class Pipeline:
    """A `Device` that is a pipeline with a configuration.

    Args:
        source: for messages.
        pipeline: new.
        config: says what the pipeline should run.
        cure: what is wrong when it cannot.

    Raises:
        InputError: it cannot.
    """

    def __init__(self, source: str, pipeline: Any, config: Any, cure: str) -> None:
        rs = library(source)
        try:
            profile = config.resolve(rs.pipeline_wrapper(pipeline))
        except RuntimeError as error:
            raise InputError(f"{source}: {cure} ({str(error).splitlines()[0]})") from error
        device = profile.get_device()
        self.intrinsics = profile.get_stream(rs.stream.color).as_video_stream_profile().intrinsics
        self.depth_unit: float = device.first_depth_sensor().get_depth_scale()
        self._source = source
        self._pipeline = pipeline
        self._config = config
        self._playback = device.as_playback() if device.is_playback() else None
        self._stopped = rs.playback_status.stopped

    def start(self) -> None:
        """Let the camera run, or play the file.

        Raises:
            InputError: another program has the camera.
        """
        if self._playback is None:
            try:
                self._pipeline.start(self._config)
            except RuntimeError as error:
                raise InputError(
                    f"{self._source}: cannot be started ({str(error).splitlines()[0]}); close what else uses the camera"
                ) from error
            return
        self._playback.set_real_time(False)  # as fast as frames are taken, and no faster
        # A file plays as soon as the first of its sensors listens, and the other would miss the beginning. Going on
        # after a pause waits for frames to be taken: hence the thread.
        self._playback.pause()
        self._pipeline.start(self._config)
        Thread(target=self._playback.resume, daemon=True).start()

    def wait(self, milliseconds: int) -> Any | None:
        """The next set of frames, None where none came in time."""
        arrived, frames = self._pipeline.try_wait_for_frames(milliseconds)
        return frames if arrived else None

    def is_over(self) -> bool:
        """Whether a file is at its end; a camera never is."""
        return self._playback is not None and self._playback.current_status() == self._stopped

    def stop(self) -> None:
        """Let go of the camera or file."""
        self._pipeline.stop()


def live(name: str, serial: str, fps: float | None) -> Pipeline:
    """A camera that is plugged in.

    Args:
        name: for messages.
        serial: number of the camera, empty for whichever there is.
        fps: frames a second to ask for; None takes 30.

    Raises:
        InputError: there is no such camera, or it has no such rate.
    """
    rs = library(name)
    context = rs.context()
    serials = [device.get_info(rs.camera_info.serial_number) for device in context.query_devices()]
    if not serials or (serial and serial not in serials):
        there = f"there are {', '.join(serials)}" if serials else "there is none; plug it into a USB 3 port"
        raise InputError(f"{name}: no such camera is connected, {there}")
    config = rs.config()
    if serial:
        config.enable_device(serial)
    rate = round(fps or _FPS)
    config.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, rate)
    config.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, rate)
    cure = f"has no colour and depth at {_SIZE[0]}x{_SIZE[1]} and {rate} frames a second; give --fps 30, 15 or 6"
    return Pipeline(name, rs.pipeline(context), config, cure)


def recorded(path: Path) -> Pipeline:
    """A file that RealSense software has recorded.

    Raises:
        InputError: the file is broken or has no colour or no depth.
    """
    rs = library(str(path))
    config = rs.config()
    config.enable_device_from_file(str(path), repeat_playback=False)
    config.enable_stream(rs.stream.color)
    config.enable_stream(rs.stream.depth)
    cure = "is broken, or was recorded without colour or depth; record it again"
    return Pipeline(str(path), rs.pipeline(), config, cure)
