"""Reading of image files with OpenCV, for images that the package wrote itself; `datasets.images` reads the others."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = 1 << 26
"""Maximum number of pixels of an image, far more than those of any RGB-D camera. The header of a small file can state
an image that would fill the memory."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG image."""

_SIZE = struct.Struct(">16xII")
"""Width and height of a PNG image; the length and type of the first chunk are before them."""


def read_image(path: Path, flags: int) -> NDArray[Any] | None:
    """Read an image file.

    Args:
        path: Image file in any format of OpenCV. `cv2.imread` cannot open a path with other than ASCII characters on
            Windows.
        flags: One of the values ``cv2.IMREAD_...``.

    Returns:
        Pixels as from `cv2.imread`, shape :math:`(H, W)` or :math:`(H, W, C)` in the order of OpenCV; None if the file
        is missing, cannot be read or is not an image, or a PNG image with more than `MAX_PIXELS`.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return None
    if content.startswith(PNG_SIGNATURE) and len(content) >= _SIZE.size:
        width, height = _SIZE.unpack_from(content)
        if width * height > MAX_PIXELS:
            return None
    try:
        return cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    except cv2.error:  # such as an empty file
        return None
