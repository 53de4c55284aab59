"""Figures and images as parts of a page: nothing that would have to be loaded."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import cv2
from matplotlib import rc_context
from matplotlib.figure import Figure

from v3d_torch.errors import InputError

_QUALITY = 88  # of images: names on objects stay sharp at a fifth of the size of a PNG


def inline_svg(figure: Figure, name: str) -> str:
    """A figure as SVG for the body of a page: what is black takes the colour of the page's text, the ground is clear.

    Args:
        figure: drawn.
        name: of the figure, different for each on the page; same figure and name, same text.
    """
    buffer = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):  # letters stay letters; ids do not clash
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :].replace("#000000", "currentColor")


def inline_image(path: Path) -> str:
    """An image as a ``data:`` address.

    Raises:
        InputError: the file is no image.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: is truncated or no image; delete it, or run again")
    encoded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1]
    return "data:image/webp;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
