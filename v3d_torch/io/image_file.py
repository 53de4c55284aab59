"""Reading of image files with OpenCV, for images that the package wrote itself; `datasets.images` reads the others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def read_image(path: Path, flags: int) -> NDArray[Any] | None:
    """Read an image file.

    Args:
        path: Image file in any format of OpenCV. `cv2.imread` cannot open a path with other than ASCII characters on
            Windows.
        flags: One of the values ``cv2.IMREAD_...``.

    Returns:
        Pixels as from `cv2.imread`, shape :math:`(H, W)` or :math:`(H, W, C)` in the order of OpenCV; None if the file
        is missing, cannot be read or is not an image.
    """
    try:
        content = np.fromfile(path, dtype=np.uint8)
    except OSError:
        return None
    return cv2.imdecode(content, flags) if content.size else None
