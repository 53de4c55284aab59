"""Estimation of an unknown depth scale."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from v3d_torch.geometry.depth_scale import UNITS, estimate_depth_scale


def room(near: float, far: float, seed: int = 0) -> NDArray[np.float64]:
    """Distances between two limits, metres, with missing pixels, shape (120, 160)."""
    rng = np.random.default_rng(seed)
    metres = rng.uniform(near, far, (120, 160))
    return np.where(rng.random(metres.shape) < 0.2, 0.0, metres)


def stored(metres: NDArray[np.floating], scale: float, step: float = 0.0) -> NDArray[np.uint16]:
    """Depth image in units of 1 / scale, of a sensor with steps of a number of metres."""
    measured = np.rint(metres / step) * step if step else metres
    return np.clip(np.rint(measured * scale), 0, 65535).astype(np.uint16)


@given(
    scale=st.sampled_from(sorted(UNITS)),
    step=st.sampled_from([0.0, 0.001, 0.002, 0.005, 0.01]),
    near=st.floats(0.25, 3.0),
    extent=st.floats(0.8, 7.0),
    seed=st.integers(0, 9),
)
@example(scale=1000.0, step=0.001, near=1.1, extent=12.0, seed=0)  # a hall, or a room in units of 0.25 mm
@example(scale=1000.0, step=0.001, near=0.1, extent=0.8, seed=0)  # a close view, or a hall in centimetres
def test_estimate_is_right_or_unknown(scale: float, step: float, near: float, extent: float, seed: int) -> None:
    estimate = estimate_depth_scale([stored(room(near, near + extent, seed), scale, step)])
    assert estimate.depth_scale in (scale, None)


@pytest.mark.parametrize(("scale", "step"), [(1000, 0.001), (1000, 0.01), (5000, 0.001), (4000, 0.001), (100, 0.01)])
def test_estimate_of_a_room_is_found(scale: float, step: float) -> None:
    estimate = estimate_depth_scale([stored(room(0.6, 4.5, seed), scale, step) for seed in range(3)])
    assert estimate.depth_scale == scale
    assert estimate.note.startswith(
        f"depth scale {scale:g} ({UNITS[scale]}), estimated from 3 depth images with values"
    )
    assert estimate.note.endswith("; state depth_scale in camera.yaml")


@pytest.mark.parametrize(
    ("image", "evidence"),
    [
        (stored(room(2.0, 7.0), 1000), "1 depth image with values from .* to .*, median .*, in steps of 1"),
        (stored(room(0.6, 1.8), 4000), "in steps of 1"),
        (stored(room(0.6, 4.5), 10000, 0.001), "in steps of 10"),  # or 2 mm in units of 0.2 mm
        (stored(room(0.3, 2.4), 5000, 0.001), "in steps of 5"),  # or a hall of 12 m, in millimetres
        (np.full((48, 64), 5000, np.uint16), r"median 5000\)"),
        (np.zeros((48, 64), np.uint16), "1 depth image without measurements"),
        (np.full((48, 64), 65535, np.uint16), "1 depth image without measurements"),
    ],
)
def test_ambiguous_images_ask_for_the_depth_scale(image: NDArray[np.uint16], evidence: str) -> None:
    estimate = estimate_depth_scale([image])
    assert estimate.depth_scale is None
    assert re.search(evidence, estimate.file_prompt)
    assert "write the line depth_scale: 1000 into camera.yaml if depth is in millimetres" in estimate.file_prompt


def test_no_images_give_no_estimate() -> None:
    assert estimate_depth_scale([]).depth_scale is None


@pytest.mark.parametrize(("count", "expected"), [(29, None), (30, 5000.0)])
def test_few_different_values_have_no_step(count: int, expected: float | None) -> None:
    """They can be multiples of a number by chance."""
    metres = np.random.default_rng(0).choice(np.linspace(0.6, 4.5, 3901), count, replace=False)
    estimate = estimate_depth_scale([stored(np.resize(metres, (120, 4 * count)).repeat(4, axis=1), 5000, 0.001)])
    assert estimate.depth_scale == expected
    assert ("in steps of 5" in estimate.evidence) == (expected is not None)


def test_few_interpolated_pixels_do_not_hide_the_step() -> None:
    image = stored(room(0.6, 4.5), 5000, 0.001)
    image[:3] += (image[:3] > 0).astype(np.uint16)
    assert estimate_depth_scale([image]).depth_scale == 5000


@pytest.mark.parametrize("name", ["crowd_static", "fr1_rpy", "walkers_crowd", "walkers_desk", "walkers_room"])
def test_estimate_for_real_images_is_right_or_unknown(real_sequence: Callable[[str], Path], name: str) -> None:
    """Whatever the unit, and with or without the steps of the sensor, for one image or several."""
    files = sorted((real_sequence(name) / "depth").glob("*.png"))
    chosen = np.linspace(0, len(files) - 1, 6).astype(int)
    metres = [cv2.imread(str(files[i]), cv2.IMREAD_UNCHANGED)[::2, ::2] / 5000 for i in chosen]
    rng = np.random.default_rng(0)
    found = set()
    for dither in (0.0, 0.0005):
        noisy = [each + (each > 0) * rng.uniform(-dither, dither, each.shape) for each in metres]
        for scale in UNITS:
            for images in ([stored(each, scale)] for each in noisy[::3]):
                assert estimate_depth_scale(images).depth_scale in (scale, None)
            estimate = estimate_depth_scale([stored(each, scale) for each in noisy]).depth_scale
            assert estimate in (scale, None)
            found |= {(estimate, dither)}
    assert (5000.0, 0.0) in found
