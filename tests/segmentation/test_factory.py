"""Construction of segmenters from a configuration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.photographs import photograph
from PIL import Image

from v3d_torch.config import SegmentationConfig
from v3d_torch.errors import ConfigError
from v3d_torch.segmentation import COCO_NAMES, MaskFolder, NoSegmentation, UprightSegmenter, make_segmenter
from v3d_torch.segmentation.factory import wrap_upright
from v3d_torch.types import RGBDFrame


def test_make_segmenter_creates_the_configured_source(tmp_path: Path) -> None:
    frame = RGBDFrame(0, 0.0, photograph("coffee"), torch.zeros(1, 400, 600))
    network = make_segmenter(SegmentationConfig(height=320, width=320, threads=1))
    assert isinstance(network, UprightSegmenter)
    assert COCO_NAMES[network(frame).labels[0]] == "cup"
    baseline = make_segmenter(SegmentationConfig(source="none"))
    assert isinstance(baseline, NoSegmentation)
    assert baseline(frame).masks.shape == (0, 400, 600)
    with pytest.raises(ConfigError, match="the folder of the id images is missing; name it with --masks"):
        make_segmenter(SegmentationConfig(source="masks"))
    Image.fromarray(np.zeros((400, 600), dtype=np.uint8)).save(tmp_path / "a.png")
    assert isinstance(make_segmenter(SegmentationConfig(source="masks"), masks_dir=tmp_path), MaskFolder)


def test_options_of_another_source_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--weights a\.onnx: not used with segmentation\.source=none; remove it"):
        make_segmenter(SegmentationConfig(source="none"), weights=Path("a.onnx"))
    with pytest.raises(ConfigError, match=r"--masks ids: not used with .*=yolo; remove it, or add --segmenter masks"):
        make_segmenter(SegmentationConfig(), masks_dir=Path("ids"))


def test_only_a_configured_network_is_kept_upright() -> None:
    source = NoSegmentation()
    assert isinstance(wrap_upright(source, SegmentationConfig()), UprightSegmenter)
    assert wrap_upright(source, SegmentationConfig(upright=False)) is source
    assert wrap_upright(source, SegmentationConfig(source="masks")) is source
