"""Writes the pictures of docs/images that are stored outputs of notebooks."""

from __future__ import annotations

import base64
import json
from pathlib import Path

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"

PICTURES = {
    "depth_row.jpg": ("voting_step_by_step", "cell-5"),
    "clusters.jpg": ("voting_step_by_step", "cell-7"),
    "distances.jpg": ("voting_step_by_step", "cell-11"),
    "votes_alone.jpg": ("voting_step_by_step", "cell-13"),
    "appeared_pixels.jpg": ("voting_step_by_step", "cell-15"),
    "chamfer.jpg": ("voting_step_by_step", "cell-21"),
    "map.jpg": ("quickstart", "cell-11"),
}
"""Notebook and cell that each picture comes from."""


def picture(notebook: str, cell: str) -> bytes:
    """Return the JPEG image among the stored outputs of a cell."""
    cells = json.loads((ROOT / "notebooks" / f"{notebook}.ipynb").read_text(encoding="utf-8"))["cells"]
    (outputs,) = (each["outputs"] for each in cells if each["id"] == cell)
    (data,) = (output["data"]["image/jpeg"] for output in outputs if "image/jpeg" in output.get("data", {}))
    return base64.b64decode("".join(data))


if __name__ == "__main__":
    for name, source in PICTURES.items():
        (IMAGES / name).write_bytes(picture(*source))
