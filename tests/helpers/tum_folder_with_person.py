"""Sequence in TUM layout, small enough for tests of whole commands: a camera along a wall, and a person before it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.corpus import base


def write_walker(folder: Path, frames: int) -> Path:
    """Write a sequence whose camera moves along a wall of noise, with a walking person and id images in ``ids``.

    Args:
        folder: Folder to write.
        frames: Number of frames.
    """
    stamps = [f"{1305031102 + i / 10:.6f}" for i in range(frames)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "STAMPS", stamps)
        patch.setattr(base, "FRAMES", frames)
        patch.setattr(base, "camera_position", lambda frame: (frame, 4 + 2 * (frame % 4)))
        base.write_base(folder)
    (folder / "ids").mkdir()
    for i, stamp in enumerate(stamps):
        depth, ids = base.depth(), np.zeros((base.HEIGHT, base.WIDTH), np.uint8)
        walker = slice(10 + 2 * i, 26 + 2 * i)
        depth[20:, walker], ids[20:, walker] = 0.6 * base.SCALE, 1
        (folder / "depth" / f"{stamp}.png").write_bytes(base.png(depth))
        (folder / "ids" / f"{stamp}.png").write_bytes(base.png(ids))
    return folder
