"""The network in 8-bit integers: what is quantised, what stays, how near its results are."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import onnx
import onnxruntime
import pytest
import torch
from helpers.photographs import photograph

import v3d_torch.segmentation.yolo
from v3d_torch.config import SegmentationConfig
from v3d_torch.segmentation import quantise as module
from v3d_torch.segmentation.export import exported_path
from v3d_torch.segmentation.quantise import quantise, quantised_path
from v3d_torch.segmentation.weights import resolve
from v3d_torch.segmentation.yolo import YOLOSegmenter

MODEL = "yolov8n-seg"
NOISE = [torch.randint(0, 256, (3, 64, 96), generator=torch.Generator().manual_seed(seed)).byte() for seed in range(2)]


@pytest.fixture(scope="module")
def exact() -> Path:
    return exported_path(MODEL, resolve(MODEL), 64, 96)


@pytest.fixture(scope="module")
def small(exact: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("quantised") / "small.onnx"
    quantise(exact, NOISE, target)
    return target


def test_inputs_and_outputs_stay_as_they_are(exact: Path, small: Path) -> None:
    sides = [onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"]) for path in (exact, small)]
    for ends in ("get_inputs", "get_outputs"):
        before, after = ([(node.name, node.type, node.shape) for node in getattr(side, ends)()] for side in sides)
        assert before == after


def test_all_convolutions_but_the_first_and_the_last_have_eight_bits(exact: Path, small: Path) -> None:
    before, after = onnx.load(exact).graph, onnx.load(small).graph
    convolutions = [node.name for node in before.node if node.op_type == "Conv"]
    made = {name: node for node in after.node for name in node.output}
    weights = {node.name: made.get(node.input[1]) for node in after.node if node.op_type == "Conv"}
    exact_ones = [name for name, source in weights.items() if source is None or source.op_type != "DequantizeLinear"]
    assert exact_ones[:5] == convolutions[:5]
    # Boxes, classes and masks at three scales.
    assert len(exact_ones) == 5 + 3 * 3 and all(name.endswith(".2/Conv") for name in exact_ones[5:])
    assert Counter(node.op_type for node in after.node)["Conv"] == len(convolutions)
    assert small.stat().st_size < 0.4 * exact.stat().st_size


def test_each_activation_is_one_operation(exact: Path, small: Path) -> None:
    before, after = (Counter(node.op_type for node in onnx.load(path).graph.node) for path in (exact, small))
    assert before["Sigmoid"] > 60 and not before["QuickGelu"]
    assert after["Sigmoid"] == 1  # of the scores
    assert after["QuickGelu"] == before["Sigmoid"] - 1
    assert after["Mul"] == before["Mul"] - after["QuickGelu"]


def test_the_same_frames_give_the_same_bytes(exact: Path, small: Path, tmp_path: Path) -> None:
    again = tmp_path / "small.onnx"
    quantise(exact, NOISE, again)
    assert again.read_bytes() == small.read_bytes()


def test_it_is_made_once(exact: Path, tmp_path: Path) -> None:
    path = tmp_path / "network.onnx"
    path.write_bytes(exact.read_bytes())
    first = quantised_path(path)
    stamp = first.stat().st_mtime_ns
    assert first.parent == tmp_path and first != path
    assert quantised_path(path) == first and first.stat().st_mtime_ns == stamp
    assert sorted(file.suffix for file in tmp_path.iterdir() if not file.name.startswith(".")) == [".onnx", ".onnx"]


def test_people_have_nearly_the_same_outlines(monkeypatch: pytest.MonkeyPatch) -> None:
    """On every processor: also where the program would run the 32-bit network in place of the 8-bit one."""
    monkeypatch.setattr(v3d_torch.segmentation.yolo, "is_worth_it", lambda: True)
    image = photograph("astronaut")
    one, other = (
        YOLOSegmenter(SegmentationConfig(precision=precision, threads=1)).segment(image)
        for precision in ("float32", "int8")
    )
    both, either = (one.masks[0] & other.masks[0]).sum(), (one.masks[0] | other.masks[0]).sum()
    assert 0.97 < both / either < 1.0


def test_a_processor_that_is_not_made_for_it_takes_floating_point(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.platform, "machine", lambda: "x86_64")
    for has_it in (False, True):
        monkeypatch.setattr(torch.cpu, "_is_vnni_supported", lambda has_it=has_it: has_it)
        assert module.has_int8_instructions() is has_it
    monkeypatch.setattr(module.platform, "machine", lambda: "aarch64")
    assert module.has_int8_instructions()
