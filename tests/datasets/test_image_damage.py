"""Damaged PNG files: no flipped bit of the pixel data goes unnoticed, whichever decoder reads them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from v3d_torch.datasets.images import decode_colour, decode_depth, read_colour, read_depth_image
from v3d_torch.errors import InputError

RANDOM = np.random.default_rng(0)
IMAGES = {
    "colour": cv2.resize(RANDOM.integers(0, 256, (8, 10, 3), np.uint8), (40, 32), interpolation=cv2.INTER_CUBIC),
    "depth": np.full((32, 40), 5000, np.uint16),
}
READ = {"colour": (read_colour, decode_colour), "depth": (read_depth_image, decode_depth)}


@pytest.mark.parametrize("kind", ["colour", "depth"])
def test_every_flipped_bit_of_pixel_data_is_detected(kind: str, tmp_path: Path) -> None:
    """The last 12 bytes are the end of the file, the 4 before them the checksum of the pixels."""
    content = cv2.imencode(".png", IMAGES[kind])[1].tobytes()
    read, decode = READ[kind]
    path = tmp_path / "image.png"
    first = content.index(b"IDAT") + 4
    for at in range(first, len(content) - 16, max(1, (len(content) - first) // 150)):
        damaged = content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"image\.png: is truncated or damaged; copy or download it again"):
            read(path)
        with pytest.raises(InputError, match="message: is truncated or damaged; copy or download it again"):
            decode(damaged, "message")
