"""Writer of sequences in TUM layout."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from v3d_torch.datasets.camera_text import camera_text
from v3d_torch.datasets.gravity_file import write_gravity_file
from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import SATURATED_DEPTH, depth_to_units
from v3d_torch.io.files import append_line, check_empty_folder, check_writable, write_png, write_text
from v3d_torch.io.timestamps import format_timestamp
from v3d_torch.types import RGBDFrame, Trajectory

_LOG = logging.getLogger(__name__)

_DEPTH_SCALE = 5000.0
"""Depth scale of the TUM benchmark, units per metre."""

_CAMERA = "camera.yaml"

_GROUND_TRUTH, _COMMENT = "groundtruth.txt", "poses of the camera, written by v3d-torch"
"""Name and first line of the file of measured poses."""


class TUMWriter:
    """Writer of RGB-D frames to a folder in TUM layout, used as a context manager.

    Each frame is written and listed immediately, so that a process that is killed loses no frame. The first one also
    writes the camera and the ground truth: a source without frames leaves the folder empty. If depth was out of range,
    a warning is logged at the end of the context.

    Args:
        folder: Folder of the sequence, new or empty.
        camera: Camera of the frames, written to ``camera.yaml``; its depth scale is the unit of the depth images, or
            5000 units per metre, as in the TUM benchmark, if it has none.
        groundtruth: Measured poses of the camera, written to ``groundtruth.txt``; None for no such file.

    Raises:
        OutputError: If the folder is not empty or cannot be written, or the disk is full. Every method can raise it.
    """

    def __init__(self, folder: Path, camera: PinholeCamera, groundtruth: Trajectory | None = None) -> None:
        check_empty_folder(folder)
        check_writable(folder / _CAMERA)
        self.folder = folder
        self._camera, self._groundtruth = camera, groundtruth
        self._depth_scale = _DEPTH_SCALE if camera.depth_scale is None else camera.depth_scale
        self._count = 0
        self._out_of_range = 0

    def __enter__(self) -> TUMWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._out_of_range:
            _LOG.warning(
                "%s: %d depth values beyond %.4g m were saved as 0; a camera with a smaller depth_scale keeps them",
                self.folder, self._out_of_range, (SATURATED_DEPTH - 1) / self._depth_scale,
            )  # fmt: skip

    def __len__(self) -> int:
        """Number of frames written."""
        return self._count

    def add(self, frame: RGBDFrame) -> None:
        """Write the images of a frame, list them, and write the gravity of the first frame if it was measured.

        Depth is rounded to units of the depth scale; beyond the 16-bit range, it is written as 0, no measurement. The
        name of each image is its stamp; the depth image of a later frame with the same depth stamp has both stamps.
        """
        if not self._count:
            self._write_camera()
            if frame.gravity is not None:
                write_gravity_file(self.folder, frame.stamp, frame.gravity)
        rgb, depth = format_timestamp(frame.stamp), format_timestamp(frame.stamp + frame.depth_delay)
        is_taken = (self.folder / "depth" / f"{depth}.png").exists()  # by an earlier frame: the folder was empty
        depth_name = f"{depth}_{rgb}" if is_taken else depth
        listed_rgb, listed_depth = f"{rgb} rgb/{rgb}.png", f"{depth} depth/{depth_name}.png"
        units, out_of_range = depth_to_units(frame.depth, self._depth_scale)
        self._out_of_range += out_of_range
        write_png(self.folder / "rgb" / f"{rgb}.png", frame.image.permute(1, 2, 0).numpy())
        write_png(self.folder / "depth" / f"{depth_name}.png", units)
        append_line(self.folder / "rgb.txt", listed_rgb)
        append_line(self.folder / "depth.txt", listed_depth)
        append_line(self.folder / "associations.txt", f"{listed_rgb} {listed_depth}")
        self._count += 1

    def _write_camera(self) -> None:
        """Write the camera, and its measured poses."""
        # The depth of the frames is already corrected.
        written = replace(self._camera, depth_scale=self._depth_scale, inverse_depth_offset=0.0)
        write_text(self.folder / _CAMERA, camera_text(written))
        if self._groundtruth is not None:
            write_trajectory(self.folder / _GROUND_TRUTH, self._groundtruth, comment=_COMMENT)


def is_recorded_truth(folder: Path) -> bool:
    """Check whether the ground truth of a folder in TUM layout was written by `TUMWriter`."""
    try:
        with (folder / _GROUND_TRUTH).open("rb") as file:
            return file.readline(len(_COMMENT) + 4).decode(errors="replace").strip() == f"# {_COMMENT}"
    except OSError:  # there is none, or it cannot be read, which is reported when the folder is opened
        return False
