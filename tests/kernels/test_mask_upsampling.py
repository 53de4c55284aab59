"""Masks upsampled by the kernel equal those of its torch twin."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.segmentation.decode import assemble_masks
from v3d_torch.segmentation.letterbox import Window

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

TWIN = TWINS[f"{assemble_masks.__module__}.{assemble_masks.__qualname__}"]

WINDOWS = [
    Window(top=0, left=0, height=96, width=128, image_height=96, image_width=128),
    Window(top=0, left=0, height=96, width=128, image_height=480, image_width=640),
    Window(top=0, left=16, height=96, width=96, image_height=300, image_width=310),
    Window(top=12, left=0, height=72, width=128, image_height=50, image_width=90),
    Window(top=44, left=60, height=8, width=8, image_height=8, image_width=20),
]


def assert_twins_agree(boxes: torch.Tensor, window: Window, seed: int, cut: int = 0) -> None:
    generator = torch.Generator().manual_seed(seed)
    # Logits of cells are integers. The weights of two by two cells are multiples of 1/15500 in the third window, and of
    # larger fractions in the others. Half of that keeps logits of pixels from 0, where the sign depends on rounding.
    prototypes = torch.randint(-2, 3, (32, 24 - cut, 32 - cut), generator=generator).float()
    coefficients = torch.randint(-1, 2, (len(boxes), 32), generator=generator).float()
    prototypes = torch.cat([prototypes, torch.ones_like(prototypes[:1])])
    coefficients = torch.cat([coefficients, torch.full((len(boxes), 1), 2.0**-15)], dim=1)
    arguments = (coefficients, prototypes, boxes, window)
    found = TWIN.compiled(*arguments, first=(cut, cut))
    assert found is not NotImplemented
    assert torch.equal(found, TWIN.torch(*arguments, first=(cut, cut)))


@pytest.mark.parametrize("window", WINDOWS)
@settings(max_examples=30)
@given(count=st.integers(0, 6), seed=st.integers(0, 10_000))
def test_masks_of_random_boxes_are_equal(window: Window, count: int, seed: int) -> None:
    size = torch.tensor([window.image_width, window.image_height])
    corners = torch.rand(count, 2, 2, generator=torch.Generator().manual_seed(seed)).sort(dim=1).values * size
    assert_twins_agree(corners.flatten(1), window, seed)


@pytest.mark.parametrize("window", WINDOWS)
def test_masks_of_degenerate_boxes_are_equal(window: Window) -> None:
    """The whole image, no pixel, one pixel in each corner, one row, one column."""
    width, height = float(window.image_width), float(window.image_height)
    boxes = [[0.0, 0.0, width, height], [0.0, 0.0, 0.0, 0.0], [width, height, width, height], [3.0, 0.0, 3.0, height]]
    boxes += [[0.0, 0.0, 1.0, 1.0], [width - 1, height - 1, width, height], [0.0, 2.0, width, 3.0]]
    boxes += [[2.0, 0.0, 3.0, height], [0.4, 0.4, 0.6, 0.6]]
    assert_twins_agree(torch.tensor(boxes), window, 5)


def test_masks_from_a_section_of_the_prototypes_are_equal() -> None:
    assert_twins_agree(torch.tensor([[200.0, 200.0, 640.0, 480.0], [300.0, 250.0, 400.0, 260.0]]), WINDOWS[1], 6, cut=8)
