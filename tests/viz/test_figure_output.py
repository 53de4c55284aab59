"""Figures and images embedded in an HTML page; no global state of pyplot."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from v3d_torch.errors import InputError
from v3d_torch.viz.figure_output import embed_image, embed_svg, save_figure
from v3d_torch.viz.stage_times import draw_stage_bars


def test_svg_has_colours_of_page_and_is_reproducible() -> None:
    one, other = (embed_svg(draw_stage_bars({"read": 0.1}), "bars") for _ in range(2))
    assert one == other
    assert one.startswith("<svg") and one.rstrip().endswith("</svg>")
    assert "#000000" not in one and "currentColor" in one
    assert ">read</text>" in one  # text, not outlines
    assert "fill: #ffffff" not in one


def test_figures_of_a_page_have_different_ids_and_refer_to_their_own() -> None:
    ids = []
    for name in ("bars", "other"):
        svg = embed_svg(draw_stage_bars({"read": 0.1}), name)
        own = re.findall(r'\sid="([^"]+)"', svg)
        assert f"{name}-figure_1" in own
        references = re.findall(r'(?:href="#|url\(#)([^")]+)', svg)
        assert references and set(references) <= set(own)
        ids += own
    assert len(ids) == len(set(ids))


def test_png_file_has_the_pixels_of_savefig(tmp_path: Path) -> None:
    for path, write in ((tmp_path / "a.png", save_figure), (tmp_path / "b.png", Figure.savefig)):
        figure = Figure(figsize=(4, 3), dpi=100, layout="constrained")
        axes = figure.add_subplot(projection="3d")
        axes.scatter(range(5), range(5), range(5), label="points")
        axes.set(title="title", xlabel="x [m]")
        figure.add_subplot(1, 4, 4).imshow(np.arange(12).reshape(3, 4))
        figure.legend(loc="outside lower center")
        write(figure, path)
    written, expected = (cv2.imread(str(tmp_path / name)) for name in ("a.png", "b.png"))
    assert written.shape == (300, 400, 3) and np.array_equal(written, expected)


def test_image_is_a_data_url_and_damaged_image_is_an_error(tmp_path: Path) -> None:
    colour = np.zeros((40, 60, 3), dtype=np.uint8)
    colour[:, :30] = (255, 0, 0)
    cv2.imwrite(str(tmp_path / "a.png"), colour[..., ::-1])
    kind, data = embed_image(tmp_path / "a.png").split(",")
    assert kind == "data:image/webp;base64"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), dtype=np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.abs(decoded.astype(int) - colour).mean() < 8
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:30])
    with pytest.raises(InputError, match=r"b\.png: is truncated or not an image; delete it"):
        embed_image(tmp_path / "b.png")
