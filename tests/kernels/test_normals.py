"""Surface normals of the kernel equal those of its torch twin."""

from __future__ import annotations

import pytest
import torch

from v3d_torch.geometry.normals import surface_normals
from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS

pytestmark = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")

TWIN = TWINS[f"{surface_normals.__module__}.{surface_normals.__qualname__}"]


@pytest.mark.parametrize("radius", [0, 1, 4])
@pytest.mark.parametrize(("height", "width"), [(40, 50), (3, 3), (2, 9), (1, 1), (0, 5)])
def test_normals_equal_those_of_the_twin(height: int, width: int, radius: int) -> None:
    """On two surfaces with noise and holes, one behind the other."""
    generator = torch.Generator().manual_seed(height + radius)
    points = torch.rand(2, height, width, 3, generator=generator)
    points[..., 2] = 2 + 0.05 * points[..., 2]
    points[:, :, width // 2 :] *= 1.5
    points[torch.rand(2, height, width, generator=generator) < 0.05] = 0
    found, expected = TWIN.compiled(points, radius), TWIN.torch(points, radius)
    assert torch.equal(found != 0, expected != 0)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("coordinates", [slice(0, 1), slice(1, 2), slice(2, 3), slice(0, 3)])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_points_that_are_not_finite_count_as_not_measured(value: float, coordinates: slice) -> None:
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(1, 40, 50, 3, generator=generator)
    points[..., 2] = 2 + 0.01 * points[..., 2]
    invalid = torch.rand(1, 40, 50, generator=generator) < 0.05
    invalid[0, 10, 10] = True
    points[..., coordinates][invalid] = value
    found, expected = TWIN.compiled(points, 2), TWIN.torch(points, 2)
    assert torch.equal(found != 0, expected != 0) and found.isfinite().all()
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
    assert (found[0, 10, [9, 11]] == 0).all() and (found[0, [9, 11], 10] == 0).all()
    assert coordinates.stop < 3 or (found[0, 10, 10] == 0).all()


def test_layout_of_the_points_does_not_matter() -> None:
    """A view of channels-first points is not contiguous."""
    points = 1 + 0.01 * torch.rand(1, 3, 20, 30, generator=torch.Generator().manual_seed(0))
    view = points.movedim(1, -1)
    assert torch.equal(surface_normals(view), surface_normals(view.contiguous()))
