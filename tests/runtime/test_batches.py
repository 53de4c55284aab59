"""Batches of arguments: those that do not fit together are errors that name the arguments."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from helpers.box_room import CAMERA
from kornia.core.exceptions import ShapeError
from torch import Tensor

import v3d_torch as v3d
from v3d_torch.errors import InputError
from v3d_torch.runtime.batches import check_shapes, common_batch

K = torch.tensor([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
INDEX = torch.zeros(5, dtype=torch.int64)


def poses(*shape: int) -> Tensor:
    return torch.eye(4).expand(*shape, 4, 4)


def images(count: int) -> Tensor:
    return torch.ones(count, 1, CAMERA.height, CAMERA.width)


def points(*shape: int) -> Tensor:
    return torch.ones(*shape, 3)


@pytest.mark.parametrize(
    ("message", "call"),
    [
        ("p (2,), q (3,)", lambda: v3d.umeyama(points(2, 5), points(3, 5))),
        ("p (2,), q (2,), weights (3,)", lambda: v3d.umeyama(points(2, 5), points(2, 5), torch.ones(3, 5))),
        ("T_gc (2,), T_ec (3,)", lambda: v3d.ate(poses(2, 5), poses(3, 5))),
        ("T_gc (2,), stamps (3,)", lambda: v3d.rpe(poses(2, 5), poses(5), torch.arange(5.0).expand(3, 5))),
        ("previous (2,), current (3,)", lambda: v3d.hough_vote(points(2, 5), points(3, 5), INDEX == 0, 0.1, 1)),
        ("a (2,), b (3,)", lambda: v3d.match_descriptors(*(torch.zeros(n, 5, 32).byte() for n in (2, 3)))),
        ("a (2,), b (3,)", lambda: v3d.match_descriptors(*(torch.zeros(n, 5, 8).byte() for n in (2, 3)))),
        ("uv_a (2,), uv_b (3,)", lambda: v3d.essential_ransac(torch.ones(2, 5, 2), torch.ones(3, 5, 2), K)),
        ("points (2,), uv (3,)", lambda: v3d.pnp_ransac(points(2, 5), torch.ones(3, 5, 2), K)),
        ("T_cw (2,), points (3,)", lambda: v3d.refine_pose(poses(2), points(3, 5), torch.ones(5, 2), K)),
        (
            "T_cw (2,), points (3,)",
            lambda: v3d.bundle_adjust(poses(2, 1), points(3, 1), torch.ones(5, 2), INDEX, INDEX, K),
        ),
        (
            "readout_jacobian (3,), T_cw (2,)",
            lambda: v3d.estimate_readout(
                0.01, 1e3, torch.ones(3, 5, 2), poses(2, 1), points(1), torch.ones(5, 2), INDEX, INDEX, K
            ),
        ),
        (
            "T_wc (2,), T_ij (3,)",
            lambda: v3d.optimise_pose_graph(poses(2, 3), torch.tensor([[0, 1]]), poses(3, 1)),
        ),
        (
            "uv (2,), row (3,)",
            lambda: v3d.compensate_rolling_shutter(
                torch.ones(2, 5, 2), torch.ones(3, 5), torch.ones(5), torch.ones(6), 0.01, K, 48
            ),
        ),
        (
            "grey_a (2,), depth_a (2,), grey_b (3,), depth_b (3,)",
            lambda: v3d.align_depth(images(2), images(2), images(3), images(3), CAMERA),
        ),
    ],
)
def test_leading_dimensions_that_do_not_broadcast_are_an_input_error(message: str, call: Callable[[], object]) -> None:
    """The error of torch did not name the arguments."""
    with pytest.raises(InputError) as error:
        call()
    assert str(error.value) == f"the leading dimensions do not broadcast: {message}; give equal ones, or 1"


def test_common_batch_is_the_broadcast_shape() -> None:
    a, b, c = torch.ones(2, 1, 5), torch.ones(3, 5, 3), torch.ones(7)
    assert common_batch(a=(a, 1), b=(b, 2), c=(c, 1), none=(None, 1), number=(0.5, 1)) == (2, 3)
    assert common_batch(c=(c, 1), number=(0.5, 0)) == ()


def test_check_shapes_returns_the_batch_of_arguments_whose_named_sizes_are_equal() -> None:
    uv, K = torch.zeros(2, 1, 5, 2), torch.zeros(3, 3)
    sigma, valid = torch.tensor(1.0), torch.ones(3, 5, dtype=torch.bool)
    assert check_shapes(uv=(uv, "N", 2), K=(K, 3, 3), sigma=(sigma, None), valid=(valid, "N"), none=(None, "N")) == (
        2,
        3,
    )


def test_check_shapes_rejects_a_named_size_that_differs() -> None:
    with pytest.raises(ShapeError, match=r"^weights has the shape \(4,\); give a tensor of shape \(\.\.\., 5\)$"):
        check_shapes(uv=(torch.zeros(5, 2), "N", 2), weights=(torch.ones(4), "N"))


def test_shapes_that_change_are_checked_in_one_compiled_graph() -> None:
    """Clouds have another size in each frame; the second size could not be compiled."""
    torch.compiler.reset()

    def add(a: Tensor, b: Tensor) -> Tensor:
        check_shapes(a=(a, "N", 3), b=(b, "N", 3))
        return a + b

    compiled = torch.compile(add, fullgraph=True, backend="eager")
    for count in (5, 7, 9):
        each = torch.rand(2, count, 3)
        assert torch.equal(compiled(each, each), 2 * each)
    with pytest.raises(ShapeError):
        check_shapes(a=(torch.rand(2, 5, 3), "N", 3), b=(torch.rand(2, 6, 3), "N", 3))
