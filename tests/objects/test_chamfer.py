"""Chamfer distance against the full distance matrix and scikit-learn's KD-tree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.library_settings import torch_threads
from hypothesis import example, given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from sklearn.neighbors import KDTree
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.objects.chamfer import ChamferDistance, chamfer_distance

DTYPES = [torch.float32, torch.float64]


def matrix_reference(p: Tensor, q: Tensor) -> Tensor:
    """Return the paper's equation with a full distance matrix."""
    squares = (p[:, None] - q[None]).square().sum(dim=-1)
    return squares.amin(dim=1).mean() + squares.amin(dim=0).mean()


def random_pair(batch: int, n: int, m: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Return clouds of an object 3 m offset: float32 matrix products lose the digits of squared distances there."""
    generator = torch.Generator().manual_seed(n + m)
    offset = torch.tensor([0.0, 0.0, 3.0], dtype=dtype)
    p = torch.rand(batch, n, 3, generator=generator, dtype=dtype) + offset
    return p, torch.rand(batch, m, 3, generator=generator, dtype=dtype) + offset + 0.01


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 40), (300, 200)])
def test_chamfer_distance_equals_the_equation(n: int, m: int, dtype: torch.dtype) -> None:
    p, q = random_pair(3, n, m, dtype)
    distance = chamfer_distance(p, q)
    assert distance.dtype == dtype
    expected = torch.stack([matrix_reference(a, b) for a, b in zip(p.double(), q.double(), strict=True)])
    torch.testing.assert_close(distance.double(), expected, rtol=1e-12 if dtype == torch.float64 else 1e-5, atol=1e-9)


SHAPES = {"box": (1.0, 1.0, 1.0), "sheet": (1.0, 2.0, 0.01), "line": (1.0, 0.0, 0.0)}


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 20_000),
    m=st.integers(1, 20_000),
    shape=st.sampled_from(sorted(SHAPES)),
    cells=st.sampled_from([0, 30]),
    offset=st.sampled_from([0.0, 3.0, 1000.0]),
    dtype=st.sampled_from(DTYPES),
)
@example(seed=0, n=20_000, m=15_000, shape="sheet", cells=0, offset=3.0, dtype=torch.float32)
def test_chamfer_distance_equals_kd_tree(
    seed: int, n: int, m: int, shape: str, cells: int, offset: float, dtype: torch.dtype
) -> None:
    generator = np.random.default_rng(seed)
    p, q = (generator.random((count, 3)) * SHAPES[shape] for count in (n, m))
    if cells:  # on a lattice, many points coincide and many distances are equal
        p, q = np.round(p * cells) / cells, np.round(q * cells) / cells
    p, q = (torch.from_numpy(cloud + offset)[None].to(dtype) for cloud in (p, q))
    a, b = p[0].double().numpy(), q[0].double().numpy()
    expected = sum(np.square(KDTree(y).query(x)[0]).mean() for x, y in [(a, b), (b, a)])
    assert chamfer_distance(p, q).item() == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_float64_far_from_the_origin_keeps_its_digits() -> None:
    p, q = random_pair(2, 300, 200)
    torch.testing.assert_close(chamfer_distance(p + 1e6, q + 1e6), chamfer_distance(p, q), rtol=1e-6, atol=0.0)


def test_clouds_of_a_batch_far_from_each_other_keep_their_digits() -> None:
    """Each pair has its own origin: relative to another pair its points would be equal in float32."""
    p, q = random_pair(3, 200, 150)
    offsets = torch.tensor([0.0, 1e6, -3e6], dtype=torch.float64)[:, None, None]
    torch.testing.assert_close(chamfer_distance(p + offsets, q + offsets), chamfer_distance(p, q), rtol=1e-5, atol=0)


def test_memory_is_linear() -> None:
    status = Path("/proc/self/status")
    p, q = random_pair(1, 20_000, 15_000, torch.float32)
    try:
        Path("/proc/self/clear_refs").write_text("5")  # reset the peak
    except OSError:
        pytest.skip("the peak of memory can be reset on Linux only")

    def kilobytes(key: str) -> int:
        return int(status.read_text().split(f"{key}:")[1].split()[0])

    before = kilobytes("VmRSS")
    chamfer_distance(p, q)
    assert kilobytes("VmHWM") - before < 100_000  # the distance matrix in float32: 1.2 GB


@settings(max_examples=60)
@given(
    p=st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=1, max_size=80),
    q=st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=1, max_size=80),
)
def test_chamfer_distance_of_random_clouds_is_symmetric_and_exact(
    p: list[tuple[int, int, int]], q: list[tuple[int, int, int]]
) -> None:
    clouds = [torch.tensor(cloud, dtype=torch.float64)[None] for cloud in (p, q)]
    distance = chamfer_distance(*clouds)
    torch.testing.assert_close(distance[0], matrix_reference(clouds[0][0], clouds[1][0]))
    torch.testing.assert_close(distance, chamfer_distance(*clouds[::-1]))  # symmetric
    assert chamfer_distance(clouds[0], clouds[0]).item() == 0


def test_convention_sum_of_mean_squares() -> None:
    p = torch.tensor([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    q = torch.tensor([[[0.0, 2.0, 0.0]]])
    # p to q: (4 + 5) / 2; q to p: 4.
    assert chamfer_distance(p, q).tolist() == [8.5]


def test_padding_does_not_change_the_distance() -> None:
    p, q = random_pair(4, 60, 50)
    generator = torch.Generator().manual_seed(1)
    p_valid = torch.rand(4, 60, generator=generator) < 0.6
    q_valid = torch.rand(4, 50, generator=generator) < 0.6
    p[~p_valid], q[~q_valid] = torch.nan, 3.0
    distance = ChamferDistance()(p, q, p_valid, q_valid)
    for b in range(4):
        torch.testing.assert_close(distance[b], matrix_reference(p[b, p_valid[b]], q[b, q_valid[b]]))


def test_empty_cloud_gives_nan_and_finite_gradients_elsewhere() -> None:
    p, q = (cloud.requires_grad_() for cloud in random_pair(3, 6, 5))
    q_valid = torch.ones(3, 5, dtype=torch.bool)
    q_valid[1] = False
    distance = chamfer_distance(p, q, q_valid=q_valid)
    assert distance.isnan().tolist() == [False, True, False]
    distance[[0, 2]].sum().backward()
    assert p.grad is not None and p.grad.isfinite().all() and p.grad[0].any() and not p.grad[1].any()
    p_valid = torch.ones(3, 6, dtype=torch.bool)
    p_valid[2] = False
    assert chamfer_distance(p, q, p_valid, torch.zeros_like(q_valid)).isnan().all()
    assert chamfer_distance(torch.zeros(2, 0, 3), torch.zeros(2, 4, 3)).isnan().all()
    assert chamfer_distance(torch.zeros(0, 3, 3), torch.zeros(0, 4, 3)).shape == (0,)


@pytest.mark.parametrize("sizes", [(1, 2), (2, 1), (3, 3)])
def test_empty_cloud_at_the_end_of_a_batch_gives_nan(sizes: tuple[int, int]) -> None:
    p, q = (torch.ones(2, size, 3) for size in sizes)
    empty = torch.tensor([True, False])
    p_valid, q_valid = (empty[:, None].expand(2, size) for size in sizes)
    for masks in ((p_valid, None), (None, q_valid), (p_valid, q_valid)):
        assert chamfer_distance(p, q, *masks).isnan().tolist() == [False, True]


def test_gradcheck() -> None:
    p, q = (cloud.requires_grad_() for cloud in random_pair(2, 7, 5))
    p_valid = torch.ones(2, 7, dtype=torch.bool)
    p_valid[0, 4:] = False
    assert torch.autograd.gradcheck(lambda p, q: chamfer_distance(p, q, p_valid), (p, q))


def test_distance_is_repeatable_and_independent_of_point_order() -> None:
    p, q = random_pair(2, 400, 300, torch.float32)
    shuffled = torch.randperm(400, generator=torch.Generator().manual_seed(2))
    distance = chamfer_distance(p, q)
    assert torch.equal(distance, chamfer_distance(p, q))
    torch.testing.assert_close(distance, chamfer_distance(p[:, shuffled], q))


def test_number_of_threads_does_not_change_the_distance() -> None:
    p, q = random_pair(3, 4000, 3000)
    distances = []
    for number in (1, 2, 3):
        with torch_threads(number):
            distances.append(chamfer_distance(p, q))
    assert torch.equal(distances[0], distances[1]) and torch.equal(distances[0], distances[2])


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e30])
def test_points_that_are_not_finite_or_too_far_away_are_rejected(bad: float) -> None:
    p, q = random_pair(1, 4, 4)
    q[0, 1, 0] = bad
    message = r"^chamfer_distance: a valid point is not finite, or farther away than 1e\+18 m; mark points"
    with pytest.raises(InputError, match=message):
        chamfer_distance(p, q)


@pytest.mark.parametrize(
    ("p", "q", "p_valid", "q_valid"),
    [
        *[((2, 4, 2), (2, 5, 3), None, None), ((2, 4, 3), (2, 5, 2), None, None), ((2, 4, 3), (1, 5, 3), None, None)],
        *[((4, 3), (5, 3), None, None), ((2, 4, 3), (2, 5, 3), (2, 3), None), ((2, 4, 3), (2, 5, 3), None, (1, 5))],
    ],
)
def test_wrong_shapes_are_rejected(
    p: tuple[int, ...], q: tuple[int, ...], p_valid: tuple[int, ...] | None, q_valid: tuple[int, ...] | None
) -> None:
    valid = [None if shape is None else torch.ones(shape, dtype=torch.bool) for shape in (p_valid, q_valid)]
    with pytest.raises(ShapeError):
        chamfer_distance(torch.zeros(p), torch.zeros(q), *valid)


def test_module_uses_both_masks() -> None:
    p, q = random_pair(2, 6, 5)
    masks = torch.arange(6) < torch.tensor([[4], [6]]), torch.arange(5) < torch.tensor([[5], [2]])
    for p_valid in (masks[0], None):
        for q_valid in (masks[1], None):
            alone = torch.stack(
                [
                    chamfer_distance(
                        p[k : k + 1] if p_valid is None else p[k : k + 1, p_valid[k]],
                        q[k : k + 1] if q_valid is None else q[k : k + 1, q_valid[k]],
                    )[0]
                    for k in range(2)
                ]
            )
            torch.testing.assert_close(ChamferDistance()(p, q, p_valid, q_valid), alone)
