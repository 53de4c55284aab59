"""Networks in parts give the same results as whole networks, on every section."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest
import torch

from v3d_torch.segmentation.export import export
from v3d_torch.segmentation.inference import NetworkOutput, SplitNetwork, WholeNetwork
from v3d_torch.segmentation.networks import LayerGraph, yolo11n_seg, yolo26n_seg, yolov8n_seg
from v3d_torch.segmentation.parts import split_paths
from v3d_torch.segmentation.quantise import quantise

HEIGHT, WIDTH = 96, 128
LEVELS = [(HEIGHT // side) * (WIDTH // side) for side in (8, 16, 32)]
"""Number of cells on each pyramid level."""

NETWORKS = [(yolov8n_seg, "float32"), (yolov8n_seg, "int8"), (yolo11n_seg, "float32"), (yolo26n_seg, "float32")]


@pytest.fixture(scope="module", params=NETWORKS, ids=lambda case: f"{case[0].__name__}-{case[1]}")
def outputs(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[NetworkOutput, NetworkOutput]:
    """Output of a whole network with random weights, and of its parts, for one image."""
    builder, precision = request.param
    return run_both(builder, precision, tmp_path_factory.mktemp("network") / "network.onnx")


def run_both(builder: Callable[[], LayerGraph], precision: str, path: Path) -> tuple[NetworkOutput, NetworkOutput]:
    torch.manual_seed(2)
    export(builder().eval(), HEIGHT, WIDTH, path)
    if precision == "int8":
        path, original = path.with_name("int8.onnx"), path
        quantise(original, [torch.randint(0, 256, (3, HEIGHT, WIDTH)).byte()], path)
    whole, parts = WholeNetwork(path, 1), SplitNetwork(split_paths(path), 1)
    assert (parts.height, parts.width) == (whole.height, whole.width) == (HEIGHT, WIDTH)
    canvas = torch.rand(1, 3, HEIGHT, WIDTH)
    return whole(canvas), parts(canvas)


def test_scores_of_parts_equal_those_of_the_whole_network(outputs: tuple[NetworkOutput, NetworkOutput]) -> None:
    whole, parts = outputs
    assert parts.scores.shape == (80, sum(LEVELS))
    assert torch.equal(parts.scores, whole.scores)


@pytest.mark.parametrize("count", [1, 3, 40, sum(LEVELS)])
def test_detections_of_any_cells_equal_those_of_the_whole_network(
    outputs: tuple[NetworkOutput, NetworkOutput], count: int
) -> None:
    whole, parts = outputs
    cells = torch.randperm(sum(LEVELS), generator=torch.Generator().manual_seed(count))[:count]
    for found, expected in zip(parts.detections(cells), whole.detections(cells), strict=True):
        assert torch.equal(found, expected)


def test_detections_of_single_levels_and_corners_equal_those_of_the_whole_network(
    outputs: tuple[NetworkOutput, NetworkOutput],
) -> None:
    whole, parts = outputs
    first = 0
    for count, width in zip(LEVELS, (WIDTH // 8, WIDTH // 16, WIDTH // 32), strict=True):
        for cell in (first, first + width - 1, first + count - width, first + count - 1):
            cells = torch.tensor([cell])
            for found, expected in zip(parts.detections(cells), whole.detections(cells), strict=True):
                assert torch.equal(found, expected)
        first += count


def test_sections_of_prototypes_equal_those_of_the_whole_network(outputs: tuple[NetworkOutput, NetworkOutput]) -> None:
    whole, parts = outputs
    all_rows = [slice(0, HEIGHT // 4), slice(0, 1), slice(5, 6), slice(6, 9), slice(HEIGHT // 4 - 1, HEIGHT // 4)]
    all_columns = [slice(0, WIDTH // 4), slice(0, 2), slice(7, 8), slice(11, 20), slice(WIDTH // 4 - 1, WIDTH // 4)]
    for rows, columns in product(all_rows, all_columns):
        assert torch.equal(parts.prototypes(rows, columns), whole.prototypes(rows, columns))


def test_parts_are_written_once(tmp_path: Path) -> None:
    path = tmp_path / "network.onnx"
    export(yolov8n_seg().eval(), 64, 64, path)
    first = split_paths(path)
    stamps = [part.stat().st_mtime_ns for part in first]
    assert split_paths(path) == first
    assert [part.stat().st_mtime_ns for part in first] == stamps
