"""Kernels and their torch twins give the same results, on the calls of a run and on random ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers import camera_inputs
from helpers.demo_frames import copy_frames
from torch import Tensor

from v3d_torch import V3DSLAM, load_sequence
from v3d_torch.backend.pose_graph import optimise_pose_graph
from v3d_torch.config import SegmentationConfig
from v3d_torch.config.loading import load_config
from v3d_torch.features.essential import essential_ransac
from v3d_torch.geometry.camera import back_project
from v3d_torch.geometry.normals import surface_normals
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS
from v3d_torch.segmentation import YOLOSegmenter
from v3d_torch.segmentation.mask_files import MaskFolder

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

Call = tuple[tuple[Any, ...], dict[str, Any]]

FRAMES = range(40, 64)
"""Frames of the demo in which people walk through the image, and some of which become keyframes."""

SEGMENTED = 6
"""Every n-th of these frames is also segmented by the network; the run itself reads masks from files."""

MAX_CALLS = 8
"""Calls of each function that are replayed, spread over the run."""


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Call]]:
    """Arguments of the functions with two implementations, recorded while the demo is tracked, and random ones."""
    recorded: dict[str, list[Call]] = {name: [] for name in TWINS}

    def record(name: str) -> Callable[..., Any]:
        def twin(*args: Any, **kwargs: Any) -> Any:
            recorded[name].append(deepcopy((args, kwargs)))
            return NotImplemented

        return twin

    with pytest.MonkeyPatch.context() as patch, torch.inference_mode():
        for name, twin in TWINS.items():
            patch.setitem(TWINS, name, twin._replace(compiled=record(name)))
        folder = tmp_path_factory.mktemp("demo")
        copy_frames(folder, FRAMES)
        sequence = load_sequence(str(folder))
        camera = replace(sequence.camera, readout=None)  # so that the map calibrates the readout
        # Rounding errors of normal equations grow with their weights; the bounds below are for weights of one.
        config = load_config(overrides=["occupancy.enabled=true", "tracking.pixel_sigma=1"])
        slam = V3DSLAM(camera, MaskFolder(folder / "masks"), config)
        for frame in sequence:
            slam(replace(frame, camera=camera))
        slam.flush()
        assert slam.occupancy is not None
        slam.occupancy.map.is_free(slam.occupancy.map.free_points[::1000], radius=0.1)
        segmenter = YOLOSegmenter(SegmentationConfig())
        for frame in list(sequence)[::SEGMENTED]:
            segmenter(frame)
            surface_normals(back_project(frame.depth[None], camera.rays))  # the map of all frames needs them
        # A short run closes no loop, and does not need essential matrices.
        optimise_pose_graph(**camera_inputs.graph(2, 15, torch.float64), robust=1.0)
        essential_ransac(**camera_inputs.two_views(2, 60, torch.float64), threshold=0.5)
    return recorded


@pytest.mark.parametrize("name", sorted(TWINS))
def test_kernel_equals_its_twin_on_the_calls_of_a_run(name: str, calls: dict[str, list[Call]]) -> None:
    step = max(1, len(calls[name]) // MAX_CALLS)
    assert calls[name], "the run does not call this function"
    compared = 0
    for args, kwargs in calls[name][::step]:
        found = TWINS[name].compiled(*deepcopy(args), **kwargs)
        if found is NotImplemented:  # for example a batch of poses
            continue
        assert_same(found, TWINS[name].torch(*deepcopy(args), **kwargs), name)
        compared += 1
    assert compared, "the kernel supports none of these calls"


def assert_same(found: Any, expected: Any, where: str) -> None:
    """Compare results: whole numbers and masks exactly, floating-point numbers up to rounding.

    A least-squares problem multiplies rounding errors by its condition number.
    """
    if callable(expected) and not isinstance(expected, Tensor):
        found, expected = found(), expected()
    assert type(found) is type(expected), where
    if isinstance(expected, Tensor):
        relative, absolute = (1e-6, 1e-9) if expected.dtype == torch.float64 else (1e-5, 1e-5)
        torch.testing.assert_close(
            found, expected, rtol=relative, atol=absolute, equal_nan=True, msg=lambda text: f"{where}: {text}"
        )
    elif isinstance(expected, np.ndarray):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=where)
    elif is_dataclass(expected) and not isinstance(expected, type):
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name), f"{where}.{field.name}")
    elif isinstance(expected, tuple | list):
        assert len(found) == len(expected), where
        for index, (a, b) in enumerate(zip(found, expected, strict=True)):
            assert_same(a, b, f"{where}[{index}]")
    elif isinstance(expected, float):
        assert math.isclose(found, expected, rel_tol=1e-9, abs_tol=1e-9), where
    else:
        assert found == expected, where
