"""RGB-D streams of Intel RealSense cameras (such as the D435i), live and from recordings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v3d_torch.datasets.camera_fields import check_distortion
from v3d_torch.datasets.cameras import CameraChoice, load_given_camera
from v3d_torch.datasets.lists import depth_delay
from v3d_torch.datasets.realsense.camera import camera_from_intrinsics, depth_scale_from, import_librealsense
from v3d_torch.datasets.realsense.device import Device, open_recorded_device
from v3d_torch.datasets.ros import read_topic_types
from v3d_torch.datasets.ros.encodings import COLOUR_ENCODINGS, convert_to_rgb
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import depth_to_metres
from v3d_torch.types import RGBDFrame

_WAIT_MS = 200
"""Maximum wait for one frame set, milliseconds: Ctrl-C and the end of the stream are handled between waits."""
_SILENCE_TIMEOUT = 5.0
"""Time without frames after which a camera counts as unplugged, seconds."""


class CapturedImages(NamedTuple):
    """Images of one frame.

    Attributes:
        stamp: Time of the colour image in the clock of the camera, seconds.
        depth_delay: Depth stamp minus colour stamp, seconds.
        colour: ``rs.video_frame`` of the colour image.
        depth: ``rs.depth_frame`` of the depth image, aligned to the colour image.
    """

    stamp: float
    depth_delay: float
    colour: Any
    depth: Any


class RealSenseStream:
    """RGB-D frames of a RealSense camera: depth aligned to colour, stamps from the clock of the camera.

    The device runs only while the stream is iterated. If frames are consumed more slowly than they arrive, a live
    camera drops some of them; a recording drops none.

    Args:
        name: Name of the stream, for tables and error messages.
        open_device: Function that opens the camera or file without starting it.
        camera: Camera chosen by the user; None for the calibration of the device.

    Raises:
        InputError: If ``open_device`` raises it, or the distortion model is not supported.
    """

    groundtruth = None

    def __init__(self, name: str, open_device: Callable[[], Device], camera: CameraChoice = None) -> None:
        device = open_device()
        self.name = name
        self.camera = _choose_camera(name, device, camera)
        self._serial = device.serial
        self._open_device = open_device

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Start the device and yield its frames.

        Raises:
            InputError: If the camera stops sending frames or sends an unsupported format.
        """
        with closing(self._images(self._open_device())) as images:
            for index, captured in enumerate(images):
                yield self._convert_frame(index, captured.stamp, captured)

    def _images(self, device: Device) -> Generator[CapturedImages, None, None]:
        """Start the device and yield the images of each frame; stop the device at the end."""
        rs = import_librealsense(self.name)
        align = rs.align(rs.stream.color)
        device.start()
        try:
            previous_stamp = -math.inf
            for frames in self._wait_for_frames(device):
                aligned = align.process(frames)
                colour, depth = aligned.get_color_frame(), aligned.get_depth_frame()
                stamp = colour.get_timestamp() / 1000
                if stamp > previous_stamp:  # otherwise it is the same colour image, paired with a newer depth image
                    yield CapturedImages(stamp, self._depth_delay(frames), colour, depth)
                    previous_stamp = stamp
        finally:
            device.stop()

    def _depth_delay(self, frames: Any) -> float:
        """Depth delay of a frame set, seconds; 0 if the stamps do not tell when its images were captured."""
        domains = import_librealsense(self.name).timestamp_domain
        colour, depth = frames.get_color_frame(), frames.get_depth_frame()
        domain = colour.get_frame_timestamp_domain()
        # Stamps in the system's time are those of arrival.
        if domain == domains.system_time or domain != depth.get_frame_timestamp_domain():
            return 0.0
        return depth_delay(colour.get_timestamp() / 1000, depth.get_timestamp() / 1000)

    def _wait_for_frames(self, device: Device) -> Iterator[Any]:
        """Yield frame sets with a colour and a depth image until the device ends."""
        last_arrival = time.monotonic()
        while not self._is_stopped():
            frames = device.wait(_WAIT_MS)
            if frames is not None:
                last_arrival = time.monotonic()
                if frames.get_color_frame() and frames.get_depth_frame():
                    yield frames
            elif device.is_over():
                return
            elif not device.is_connected() or time.monotonic() - last_arrival > _SILENCE_TIMEOUT:
                raise InputError(f"{self.name}: sends no images; plug the camera into a USB 3 port")

    def _is_stopped(self) -> bool:
        """Check whether another thread ended the iteration."""
        return False

    def _convert_frame(self, index: int, stamp: float, captured: CapturedImages) -> RGBDFrame:
        colour, depth = captured.colour, captured.depth
        encoding = colour.get_profile().format().name
        if encoding not in COLOUR_ENCODINGS:
            raise InputError(f"{self.name}: sends colour in the unsupported format {encoding}; record it as rgb8")
        width, height = colour.get_width(), colour.get_height()
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{self.name}: sends {width}x{height} pixels, --camera has {self.camera.width}x{self.camera.height};"
                " remove --camera to use the calibration of the device"
            )
        # librealsense reuses the memory of both images: convert_to_rgb and depth_to_metres copy it.
        pixels = np.asanyarray(colour.get_data()).view(np.uint8).reshape(height, width, COLOUR_ENCODINGS[encoding][0])
        units = np.asanyarray(depth.get_data())
        metres = self.camera.correct_depth(depth_to_metres(units, self.camera.depth_scale))
        image = convert_to_rgb(encoding, pixels)
        return RGBDFrame(index, stamp, image, metres, depth_delay=captured.depth_delay, camera=self.camera)


def _choose_camera(name: str, device: Device, camera: CameraChoice) -> PinholeCamera:
    """Camera of the user with the depth scale of the device if it states none; without one, that of the device."""
    if camera is None:
        calibrated = camera_from_intrinsics(name, device.intrinsics, device.depth_unit)
        check_distortion(calibrated, name)
        return calibrated
    given = load_given_camera(camera, lambda: (device.intrinsics.width, device.intrinsics.height))
    return given if given.depth_scale is not None else replace(given, depth_scale=depth_scale_from(device.depth_unit))


def open_realsense_recording(path: Path, camera: CameraChoice = None) -> RealSenseStream:
    """Open a file that RealSense software recorded as a stream, see `open_recorded_device`."""
    return RealSenseStream(path.resolve().stem, partial(open_recorded_device, path), camera)


def is_realsense_recording(path: Path) -> bool:
    """Check whether a bag was recorded by RealSense software.

    Such a bag needs librealsense: its depth is not aligned to colour, and it has no CameraInfo of ROS.
    """
    is_bag_file = path.suffix in (".bag", ".db3") and path.is_file()
    return is_bag_file and any(topic.startswith("/device_0/") for topic in read_topic_types(path))
