"""Output of figures and images: as files, and embedded in an HTML page."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from v3d_torch.errors import InputError
from v3d_torch.io.files import atomic_write
from v3d_torch.io.image_file import read_image

_WEBP_QUALITY = 88
"""Quality of embedded images, 0 to 100: high enough to keep small text sharp."""

_PNG_COMPRESSION = 3
"""Level 0 to 9. Files are about as large as at matplotlib's level 6, and written several times faster."""


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure to a file, atomically.

    Args:
        figure: Figure to write.
        path: Image file; the suffix (.png, .pdf, .svg) selects the format.

    Raises:
        OutputError: If the file cannot be written.
    """
    encoded = _encode_png(figure) if path.suffix == ".png" else None
    with atomic_write(path) as temporary:
        if encoded is None:
            figure.savefig(temporary)
        else:
            temporary.write_bytes(encoded)


def _encode_png(figure: Figure) -> bytes:
    """Return a figure as a PNG file, with the pixels of ``savefig``, which draws twice and compresses slowly."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., 2::-1]
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION])[1].tobytes()


def embed_svg(figure: Figure, name: str) -> str:
    """Return a figure as an SVG element that follows the colours of the page.

    Black becomes the text colour of the page, and the background is transparent. Text stays text. The same figure and
    name give the same bytes.

    Args:
        figure: Figure to embed.
        name: Name of the figure, unique within the page: its ids begin with it, or are hashes that contain it.
    """
    buffer = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text.replace('<g id="', f'<g id="{name}-')  # the names of groups, figure_1 etc., are those of every figure
    return text[text.index("<svg") :].replace("#000000", "currentColor")


def embed_image(path: Path) -> str:
    """Return an image file as a ``data:`` URL.

    Args:
        path: Image file in any format of OpenCV.

    Raises:
        InputError: If the file is not an image.
    """
    image = read_image(path, cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: is truncated or not an image; delete it, or run the sequence again")
    encoded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY])[1]
    return "data:image/webp;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")
