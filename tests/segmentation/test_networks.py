"""Networks as modules: shapes, published sizes, conventions of the head, export."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn

from v3d_torch.segmentation.export import export
from v3d_torch.segmentation.networks import LayerGraph, one_to_one, yolo11n_seg, yolo26n_seg, yolov8n_seg
from v3d_torch.segmentation.networks.attention import Attention
from v3d_torch.segmentation.networks.head import DFL, Segment, dense_branch
from v3d_torch.segmentation.networks.prototypes import Proto
from v3d_torch.segmentation.onnx_runtime import import_onnxruntime

BUILDERS = [yolov8n_seg, yolo11n_seg, yolo26n_seg]


@pytest.mark.parametrize("builder", BUILDERS)
@pytest.mark.parametrize(("batch", "height", "width"), [(1, 64, 96), (2, 96, 32)])
def test_output_shapes_follow_batch_and_image_size(
    builder: Callable[[], LayerGraph], batch: int, height: int, width: int
) -> None:
    torch.manual_seed(0)
    with torch.inference_mode():
        predictions, prototypes = builder().eval()(torch.rand(batch, 3, height, width))
    cells = sum((height // stride) * (width // stride) for stride in (8, 16, 32))
    assert predictions.shape == (batch, 116, cells)
    assert prototypes.shape == (batch, 32, height // 4, width // 4)
    scores = predictions[:, 4:84]
    assert (scores >= 0).all() and (scores <= 1).all()


@pytest.mark.parametrize(("builder", "millions"), [(yolov8n_seg, 3.4), (yolo11n_seg, 2.9), (yolo26n_seg, 2.7)])
def test_number_of_parameters_equals_the_published_one(builder: Callable[[], LayerGraph], millions: float) -> None:
    assert round(sum(p.numel() for p in builder().parameters()) / 1e6, 1) == millions


def test_dfl_returns_the_expected_bin() -> None:
    dfl = DFL(16)
    dfl.conv.weight.data = torch.arange(16.0).view(1, 16, 1, 1)
    logits = torch.randn(2, 64, 5, generator=torch.Generator().manual_seed(0))
    probabilities = logits.view(2, 4, 16, 5).softmax(dim=2).numpy()
    expected = np.einsum("bskn,k->bsn", probabilities, np.arange(16))
    np.testing.assert_allclose(dfl(logits).detach().numpy(), expected, rtol=1e-5)


def test_convention_boxes_are_centre_and_size_around_cell_centres() -> None:
    """All cells predict distances of 1, 0, 3 and 2 cells to the edges, so the first box of each level is known."""
    head = Segment((8, 8, 8), Proto(8), bins=1, classifier=dense_branch).eval()
    for branch in head.cv2:
        branch[-1].weight.data.zero_()
        branch[-1].bias.data = torch.tensor([1.0, 0.0, 3.0, 2.0])
    predictions, _ = head([torch.rand(1, 8, 8 // scale, 12 // scale) for scale in (1, 2, 4)])
    first_cells = [0, 8 * 12, 8 * 12 + 4 * 6]
    for cell, stride in zip(first_cells, (8, 16, 32), strict=True):
        expected = torch.tensor([0.5 + 1.0, 0.5 + 1.0, 4.0, 2.0]) * stride
        torch.testing.assert_close(predictions[0, :4, cell], expected)
    assert predictions[0, 0, 1] - predictions[0, 0, 0] == 8  # cells are in row-major order
    assert predictions[0, 1, 12] - predictions[0, 1, 0] == 8


def test_attention_equals_scaled_dot_product_attention() -> None:
    torch.manual_seed(0)
    attention = Attention(128).eval()
    attention.pe, attention.proj = nn.Conv2d(128, 128, 1), nn.Identity()
    attention.pe.weight.data.zero_()
    attention.pe.bias.data.zero_()
    x = torch.randn(2, 128, 3, 5)
    q, k, v = attention.qkv(x).view(2, 2, 128, 15).split([32, 32, 64], dim=2)
    expected = nn.functional.scaled_dot_product_attention(q.mT, k.mT, v.mT).mT.reshape(2, 128, 3, 5)
    torch.testing.assert_close(attention(x), expected, rtol=1e-4, atol=1e-5)


def test_one_to_one_replaces_the_one_to_many_branches() -> None:
    tensors = {
        "model.23.one2one_cv2.0": torch.ones(1),
        "model.23.cv2.0": torch.zeros(1),
        "model.0": torch.full((1,), 2.0),
    }
    for order in (tensors, dict(reversed(tensors.items()))):
        replaced = one_to_one(order)
        assert replaced["model.23.cv2.0"] == 1
        assert replaced["model.0"] == 2


@pytest.mark.parametrize("builder", BUILDERS)
def test_export_gives_the_outputs_of_the_module(builder: Callable[[], LayerGraph], tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = builder().eval()
    path = tmp_path / "network.onnx"
    export(network, 64, 96, path)
    onnx.checker.check_model(onnx.load(path))
    session = import_onnxruntime().InferenceSession(path, providers=["CPUExecutionProvider"])
    assert [node.name for node in session.get_outputs()] == ["output0", "output1"]
    image = torch.rand(1, 3, 64, 96)
    with torch.inference_mode():
        expected = network(image)
    for exported, module_output in zip(session.run(None, {"images": image.numpy()}), expected, strict=True):
        assert exported.dtype == np.float32
        np.testing.assert_allclose(exported, module_output.numpy(), rtol=1e-4, atol=1e-4)
