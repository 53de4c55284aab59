"""Lossless videos of colour and 16-bit depth images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def write_video(path: Path, fps: float, images: list[NDArray[np.uint8]] | list[NDArray[np.uint16]]) -> None:
    """Write RGB images of 8 bits or depth images of 16 bits as an FFV1 video."""
    height, width = images[0].shape[:2]
    is_depth = images[0].dtype == np.uint16
    options = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0] if is_depth else []
    codec = cv2.VideoWriter_fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, fps, (width, height), options)
    assert writer.isOpened()
    for image in images:
        writer.write(image if is_depth else cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
