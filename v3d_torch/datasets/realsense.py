"""Intel RealSense cameras (D435i and its kin), live and from the files that their software records."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from v3d_torch.datasets import realsense_device
from v3d_torch.datasets.bag import topic_types
from v3d_torch.datasets.cameras import CameraChoice, choose_camera
from v3d_torch.datasets.encodings import COLOURS, to_rgb
from v3d_torch.datasets.images import depth_to_metres
from v3d_torch.datasets.realsense_camera import camera_of, library, per_metre
from v3d_torch.datasets.realsense_device import Device
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.types import RGBDFrame

_WAIT = 200
"""Between looks at whether the stream has ended or the user has interrupted, milliseconds."""
_PATIENCE = 5.0
"""A camera that sends nothing for so long has been unplugged, seconds."""


class RealSenseStream:
    """Frames of a camera: depth aligned to colour, stamps of the camera's own clock.

    The camera runs while the stream is iterated over. Where frames are taken slower than they come, some of a live
    camera's are left out, but none of a file's.

    Args:
        name: for tables and messages.
        open_device: opens the camera or file, not running yet.
        camera: the user's choice; None takes the camera's own calibration.

    Raises:
        InputError: as ``open_device``, or the camera's lens is of a kind unknown here.
    """

    groundtruth = None

    def __init__(self, name: str, open_device: Callable[[], Device], camera: CameraChoice = None) -> None:
        device = open_device()
        own = None if camera is not None else camera_of(name, device.intrinsics, device.depth_unit)
        self.name = name
        self.camera: PinholeCamera = choose_camera(camera, Path(name), own)
        self._open_device = open_device

    def __iter__(self) -> Iterator[RGBDFrame]:
        """Frames as they come.

        Raises:
            InputError: the camera falls silent, or sends what cannot be read.
        """
        rs = library(self.name)
        align = rs.align(rs.stream.color)
        device = self._open_device()
        device.start()
        try:
            index, last = 0, -math.inf
            for frames in self._sets(device):
                both = align.process(frames)
                colour, depth = both.get_color_frame(), both.get_depth_frame()
                stamp = colour.get_timestamp() / 1000
                if stamp <= last:  # the same image again, with a new depth image
                    continue
                yield self._frame(index, stamp, colour, depth, per_metre(device.depth_unit))
                index, last = index + 1, stamp
        finally:
            device.stop()

    def _sets(self, device: Device) -> Iterator[Any]:
        """Sets of a colour and a depth image, until the end."""
        came = time.monotonic()
        while True:
            frames = device.wait(_WAIT)
            if frames is not None:
                came = time.monotonic()
                if frames.get_color_frame() and frames.get_depth_frame():
                    yield frames
            elif device.is_over():
                return
            elif time.monotonic() - came > _PATIENCE:
                raise InputError(f"{self.name}: sends no images; plug the camera into a USB 3 port and start again")

    def _frame(self, index: int, stamp: float, colour: Any, depth: Any, units_per_metre: float) -> RGBDFrame:
        encoding = colour.get_profile().format().name
        if encoding not in COLOURS:
            raise InputError(f"{self.name}: sends colour as {encoding}, which is not known here; record it as rgb8")
        width, height = colour.get_width(), colour.get_height()
        if (width, height) != (self.camera.width, self.camera.height):
            raise InputError(
                f"{self.name}: sends {width}x{height} pixels, --camera has {self.camera.width}x{self.camera.height};"
                " leave --camera out, it brings its own"
            )
        # The memory of both images is librealsense's, which uses it again: what is made of it is a copy.
        pixels = np.asanyarray(colour.get_data()).view(np.uint8).reshape(height, width, COLOURS[encoding][0])
        units = np.asanyarray(depth.get_data())
        image, measured = to_rgb(encoding, pixels), depth_to_metres(units, units_per_metre)
        return RGBDFrame(index, stamp, image, measured, camera=self.camera)


def open_camera(name: str, camera: CameraChoice = None, *, fps: float | None = None) -> RealSenseStream:
    """A camera that is plugged in.

    Args:
        name: ``realsense:``, or ``realsense:SERIAL`` where there are several.
        camera: the user's choice; None takes the camera's own calibration.
        fps: frames a second to ask for; None takes the usual.

    Raises:
        InputError: see `realsense_device.live`.
    """
    serial = name.partition(":")[2]
    label = f"realsense_{serial}" if serial else "realsense"  # which can be a folder's name
    return RealSenseStream(label, partial(realsense_device.live, label, serial, fps), camera)


def open_recording(path: Path, camera: CameraChoice = None) -> RealSenseStream:
    """A file that RealSense software has recorded, see `realsense_device.recorded`."""
    return RealSenseStream(path.resolve().stem, partial(realsense_device.recorded, path), camera)


def is_recording(path: Path) -> bool:
    """Whether a bag was recorded by RealSense software: depth is not aligned in it, and its cameras are not ROS's."""
    bag = path.suffix in (".bag", ".db3") and path.is_file()
    return bag and any(topic.startswith("/device_0/") for topic in topic_types(path))
