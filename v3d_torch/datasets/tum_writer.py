"""Saves frames as a folder in TUM layout."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from v3d_torch.datasets.images import SATURATED
from v3d_torch.datasets.tum_trajectory import write_trajectory
from v3d_torch.errors import OutputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.files import atomic_write, write_text
from v3d_torch.types import RGBDFrame, Trajectory


class TUMWriter:
    """A folder that is being written; as a context manager it writes its lists at the end, however it comes.

    Args:
        folder: new or empty.
        camera: of the frames, kept as ``camera.yaml``; depth is written in its units.
        groundtruth: poses of that camera, kept as ``groundtruth.txt``.

    Raises:
        OutputError: the folder holds something, cannot be written, or the disk is full; also later.
    """

    def __init__(self, folder: Path, camera: PinholeCamera, groundtruth: Trajectory | None = None) -> None:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder}: holds something already; choose another folder with --out")
        self.folder = folder
        self.camera = camera
        self._written: list[tuple[str, str]] = []
        fields = asdict(camera) | {"distortion": list(camera.distortion)}
        write_text(folder / "camera.yaml", yaml.safe_dump(fields, sort_keys=False))
        if groundtruth is not None:
            write_trajectory(folder / "groundtruth.txt", groundtruth)

    def __enter__(self) -> TUMWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        lines = {
            "rgb.txt": [f"{stamp} rgb/{stamp}.png" for stamp, _ in self._written],
            "depth.txt": [f"{stamp} depth/{stamp}.png" for _, stamp in self._written],
            "associations.txt": [f"{rgb} rgb/{rgb}.png {depth} depth/{depth}.png" for rgb, depth in self._written],
        }
        for name, entries in lines.items():
            write_text(self.folder / name, "".join(f"{entry}\n" for entry in entries))

    def __len__(self) -> int:
        """Frames written."""
        return len(self._written)

    def add(self, frame: RGBDFrame) -> None:
        """Write a frame's images; depth that 16 bits of the camera's units cannot tell is no measurement."""
        stamps = f"{frame.stamp:.6f}", f"{frame.stamp + frame.depth_delay:.6f}"
        units = np.rint(frame.depth[0].numpy() * self.camera.depth_scale)
        units[units >= SATURATED] = 0
        colour = np.ascontiguousarray(frame.image.permute(1, 2, 0).numpy()[..., ::-1])
        _save(self.folder / "rgb" / f"{stamps[0]}.png", colour)
        _save(self.folder / "depth" / f"{stamps[1]}.png", units.astype(np.uint16))
        self._written.append(stamps)


def _save(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    encoded = cv2.imencode(".png", image)[1]
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.tobytes())
