"""Quantised networks: operators that are quantised, accuracy of the results, caching."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import onnx
import pytest
import torch
from helpers.photographs import photograph

import v3d_torch.segmentation.yolo
from v3d_torch.config import SegmentationConfig
from v3d_torch.segmentation import quantise as module
from v3d_torch.segmentation.export import exported_path
from v3d_torch.segmentation.onnx_runtime import import_onnxruntime
from v3d_torch.segmentation.quantise import quantise, quantised_path
from v3d_torch.segmentation.weights import find_weights
from v3d_torch.segmentation.yolo import YOLOSegmenter

MODEL = "yolov8n-seg"
NOISE = [torch.randint(0, 256, (3, 64, 96), generator=torch.Generator().manual_seed(seed)).byte() for seed in range(2)]


@pytest.fixture(scope="module")
def original() -> Path:
    return exported_path(MODEL, find_weights(MODEL), 64, 96)


@pytest.fixture(scope="module")
def quantised(original: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("quantised") / "small.onnx"
    quantise(original, NOISE, target)
    return target


def test_quantisation_keeps_inputs_and_outputs(original: Path, quantised: Path) -> None:
    sessions = [
        import_onnxruntime().InferenceSession(str(path), providers=["CPUExecutionProvider"])
        for path in (original, quantised)
    ]
    for getter in ("get_inputs", "get_outputs"):
        before, after = (
            [(node.name, node.type, node.shape) for node in getattr(session, getter)()] for session in sessions
        )
        assert before == after


def test_all_convolutions_except_the_first_and_the_output_layers_are_quantised(original: Path, quantised: Path) -> None:
    before, after = onnx.load(original).graph, onnx.load(quantised).graph
    convolutions = [node.name for node in before.node if node.op_type == "Conv"]
    producers = {name: node for node in after.node for name in node.output}
    weights = {node.name: producers.get(node.input[1]) for node in after.node if node.op_type == "Conv"}
    float_convolutions = [
        name for name, source in weights.items() if source is None or source.op_type != "DequantizeLinear"
    ]
    assert float_convolutions[:5] == convolutions[:5]
    # Output layers: boxes, classes and mask coefficients on three levels.
    assert len(float_convolutions) == 5 + 3 * 3 and all(name.endswith(".2/Conv") for name in float_convolutions[5:])
    assert Counter(node.op_type for node in after.node)["Conv"] == len(convolutions)
    assert quantised.stat().st_size < 0.4 * original.stat().st_size


def test_each_activation_is_fused_into_one_operator(original: Path, quantised: Path) -> None:
    before, after = (Counter(node.op_type for node in onnx.load(path).graph.node) for path in (original, quantised))
    assert before["Sigmoid"] > 60 and not before["QuickGelu"]
    assert after["Sigmoid"] == 1  # of the scores
    assert after["QuickGelu"] == before["Sigmoid"] - 1
    assert after["Mul"] == before["Mul"] - after["QuickGelu"]


def test_same_calibration_images_give_the_same_bytes(original: Path, quantised: Path, tmp_path: Path) -> None:
    again = tmp_path / "small.onnx"
    quantise(original, NOISE, again)
    assert again.read_bytes() == quantised.read_bytes()


def test_quantised_file_is_written_once(original: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CALIBRATION_INTERVAL", 60)  # two frames, because rendering takes long
    path = tmp_path / "network.onnx"
    path.write_bytes(original.read_bytes())
    first = quantised_path(path)
    stamp = first.stat().st_mtime_ns
    assert first.parent == tmp_path and first != path
    assert quantised_path(path) == first and first.stat().st_mtime_ns == stamp
    assert sorted(file.suffix for file in tmp_path.iterdir() if not file.name.startswith(".")) == [".onnx", ".onnx"]


def test_quantised_network_gives_nearly_the_same_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    """The 8-bit network runs on every processor here, also on those for which the segmenter would not use it."""
    monkeypatch.setattr(v3d_torch.segmentation.yolo, "has_int8_instructions", lambda: True)
    image = photograph("astronaut")
    in_float32, in_int8 = (
        YOLOSegmenter(SegmentationConfig(precision=precision, threads=1)).segment(image)
        for precision in ("float32", "int8")
    )
    intersection = (in_float32.masks[0] & in_int8.masks[0]).sum()
    union = (in_float32.masks[0] | in_int8.masks[0]).sum()
    assert 0.97 < intersection / union < 1.0


def test_int8_instructions_are_detected_on_x86_and_assumed_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.platform, "machine", lambda: "x86_64")
    for has_vnni in (False, True):
        monkeypatch.setattr(torch.cpu, "_is_vnni_supported", lambda has_vnni=has_vnni: has_vnni)
        assert module.has_int8_instructions() is has_vnni
    monkeypatch.setattr(module.platform, "machine", lambda: "aarch64")
    assert module.has_int8_instructions()
