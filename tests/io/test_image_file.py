"""Reading of image files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.corpus.images import bomb

from v3d_torch.datasets.demo.pictures import load_photograph
from v3d_torch.errors import InputError
from v3d_torch.io.files import write_png
from v3d_torch.io.image_file import read_image
from v3d_torch.runs.report_page import _masked_fraction
from v3d_torch.runs.run_images import _read_mask
from v3d_torch.viz.figure_output import embed_image


def test_image_is_that_of_opencv(tmp_path: Path) -> None:
    path, pixels = tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    write_png(path, pixels)
    for flags in (cv2.IMREAD_COLOR, cv2.IMREAD_GRAYSCALE, cv2.IMREAD_UNCHANGED):
        read = read_image(path, flags)
        assert read is not None and np.array_equal(read, cv2.imread(str(path), flags))


def test_file_that_is_not_an_image_gives_none(tmp_path: Path) -> None:
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("text")
    (tmp_path / "header.png").write_bytes(bomb(5, 7, 8, 0)[:20])
    (tmp_path / "empty image.png").write_bytes(bomb(0, 7, 8, 0))
    for name in ("missing.png", "empty.png", "text.png", "header.png", "empty image.png", "."):
        assert read_image(tmp_path / name, cv2.IMREAD_COLOR) is None


@pytest.mark.parametrize("side", [60_000, 9_000])
def test_image_that_would_fill_the_memory_is_not_decoded(side: int, tmp_path: Path) -> None:
    (tmp_path / "large.png").write_bytes(bomb(side, side, 8, 0))
    assert read_image(tmp_path / "large.png", cv2.IMREAD_GRAYSCALE) is None


def test_no_image_is_opened_by_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot open a path with other than ASCII characters on Windows."""

    def imread(*_: object) -> None:
        raise AssertionError("OpenCV opens a file")

    monkeypatch.setattr(cv2, "imread", imread)
    path, mask = tmp_path / "größe.png", np.array([[0, 255], [0, 0]], dtype=np.uint8)
    write_png(path, mask)
    assert _masked_fraction(path) == 0.25
    assert _read_mask(path, (2, 2)).tolist() == [[True, False], [True, True]]  # type: ignore[arg-type]
    assert embed_image(path).startswith("data:image/webp;base64,")
    assert load_photograph("cup.png").shape[2] == 4 and load_photograph("cat.jpg").shape[2] == 3
    with pytest.raises(InputError, match="install the package again"):
        load_photograph("missing.png")
