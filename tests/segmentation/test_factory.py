"""Construction of segmenters from a configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.photographs import photograph
from PIL import Image

from v3d_torch.config import Config, SegmentationConfig
from v3d_torch.config.loading import load_config
from v3d_torch.errors import ConfigError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.segmentation import COCO_NAMES, MaskFolder, NoSegmentation, UprightSegmenter, make_segmenter
from v3d_torch.segmentation.factory import check_network_is_used, wrap_upright
from v3d_torch.types import RGBDFrame, Segmenter

CAMERA = PinholeCamera(fx=500.0, fy=500.0, cx=299.5, cy=199.5, width=600, height=400)


def make(arguments: dict[str, Path] | None = None, **values: Any) -> Segmenter:
    return make_segmenter(Config(segmentation=SegmentationConfig(**values)), CAMERA, **(arguments or {}))


def test_make_segmenter_creates_the_configured_source(tmp_path: Path) -> None:
    frame = RGBDFrame(0, 0.0, photograph("coffee"), torch.zeros(1, 400, 600))
    network = make(height=320, width=320, threads=1)
    assert isinstance(network, UprightSegmenter)
    assert COCO_NAMES[network(frame).labels[0]] == "cup"
    baseline = make(source="none")
    assert isinstance(baseline, NoSegmentation)
    assert baseline(frame).masks.shape == (0, 400, 600)
    with pytest.raises(ConfigError, match="the folder of the id images is missing; only `run` takes one, with --masks"):
        make(source="masks")
    Image.fromarray(np.zeros((400, 600), dtype=np.uint8)).save(tmp_path / "a.png")
    assert isinstance(make({"masks_dir": tmp_path}, source="masks"), MaskFolder)


def test_options_of_another_source_are_rejected() -> None:
    with pytest.raises(ConfigError, match=r"--weights a\.onnx: not used with segmentation\.source=none; remove it"):
        make({"weights": Path("a.onnx")}, source="none")
    with pytest.raises(ConfigError, match=r"--masks ids: not used with .*=yolo; remove it, or add --segmenter masks"):
        make({"masks_dir": Path("ids")})


def test_option_of_the_network_is_rejected_with_another_segmenter() -> None:
    check_network_is_used("--model yolo11n-seg", Config())
    with pytest.raises(ConfigError, match=r"^--model m: not used with segmentation\.source=none; remove it, or add --"):
        check_network_is_used("--model m", load_config(overrides="segmentation.source=none"))
    with pytest.raises(ConfigError, match=r"^--model m: not used with stages\.segment=lab:Own; remove one of them$"):
        check_network_is_used("--model m", load_config(overrides="stages.segment=lab:Own"))


def test_only_a_configured_network_is_kept_upright() -> None:
    source = NoSegmentation()
    assert isinstance(wrap_upright(source, SegmentationConfig()), UprightSegmenter)
    assert wrap_upright(source, SegmentationConfig(upright=False)) is source
    assert wrap_upright(source, SegmentationConfig(source="masks")) is source
