"""Derivatives of a bundle adjustment and of the readout estimate; padding, weights."""

from __future__ import annotations

import pytest
import torch
from helpers import camera_inputs
from helpers.gradients import check_gradients
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.core.exceptions import ShapeError
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.mapping.bundle_adjustment import bundle_adjust
from v3d_torch.mapping.readout_calibration import estimate_readout

CONVERGED = {"iterations": 150, "tolerance": 1e-15}
OBSERVATIONS = 24


def bundle(batch: int = 2) -> dict[str, Tensor]:
    """Problems in which every seventh observation is padding and some lie where Huber's loss is linear."""
    inputs = camera_inputs.bundle(batch, OBSERVATIONS, torch.float64)
    inputs["uv"][:, ::5] += 4.0
    return inputs | {"valid": torch.arange(OBSERVATIONS).expand(batch, -1) % 7 > 0}


def test_gradients_equal_finite_differences() -> None:
    """With respect to pixels, depths, intrinsics, standard deviations, weights, and the fixed pose."""
    inputs = bundle()
    measured = inputs["inverse_depth"] > 0

    def adjusted(uv: Tensor, K: Tensor, depth: Tensor, sigmas: Tensor, weights: Tensor, xi: Tensor) -> Tensor:
        anchor = se3_exp(xi) @ inputs["T_cw"][:, :1]
        inverse_depth = torch.where(measured, inputs["inverse_depth"] / (1 + depth), 0.0)
        given = {"T_cw": torch.cat([anchor, inputs["T_cw"][:, 1:]], dim=1), "uv": uv, "K": K, "weights": weights}
        pixel_sigma, inverse_depth_sigma = sigmas.exp()
        noise = {"pixel_sigma": pixel_sigma, "inverse_depth_sigma": 0.02 * inverse_depth_sigma}
        found = bundle_adjust(**inputs | given | {"inverse_depth": inverse_depth}, **noise, **CONVERGED)
        return torch.cat([found.T_cw.flatten(1), found.points.flatten(1), 0.01 * found.cost_after[:, None]], dim=1)

    zeros = torch.zeros_like(inputs["inverse_depth"]), torch.zeros(2, dtype=torch.float64)
    xi = torch.zeros(2, 1, 6, dtype=torch.float64)
    assert check_gradients(adjusted, inputs["uv"], inputs["K"], *zeros, inputs["weights"], xi)


def test_initial_estimate_has_no_gradient() -> None:
    inputs = bundle()
    T_cw, points = (inputs.pop(name).requires_grad_() for name in ("T_cw", "points"))
    found = bundle_adjust(T_cw, points, **inputs)
    by_pose, by_point = torch.autograd.grad(found.points.sum(), (T_cw, points), allow_unused=True)
    assert by_point is None
    assert by_pose[:, 0].any() and not by_pose[:, 1:].any()  # the first pose is fixed: the map moves along


def test_convention_a_weight_counts_an_observation_so_many_times() -> None:
    inputs = camera_inputs.bundle(1, OBSERVATIONS, torch.float64) | {"weights": None, "valid": None}
    weights = 1 + torch.arange(OBSERVATIONS) % 2
    repeats = torch.arange(OBSERVATIONS).repeat_interleave(weights)
    repeated = {
        name: each[:, repeats] if each is not None and each.shape[1:2] == (OBSERVATIONS,) else each
        for name, each in inputs.items()
    }
    found = bundle_adjust(**inputs | {"weights": weights[None]}, **CONVERGED)
    expected = bundle_adjust(**repeated, **CONVERGED)
    torch.testing.assert_close(found.cost_after, expected.cost_after)
    torch.testing.assert_close(found.T_cw, expected.T_cw, rtol=0, atol=1e-6)


@settings(max_examples=15)
@given(st.lists(st.booleans(), min_size=OBSERVATIONS, max_size=OBSERVATIONS))
def test_padding_between_observations_has_no_effect(present: list[bool]) -> None:
    inputs, valid = camera_inputs.bundle(1, OBSERVATIONS, torch.float64), torch.tensor(present)
    per_observation = [name for name, each in inputs.items() if each.shape[1:2] == (OBSERVATIONS,)]
    alone = {name: each[:, valid] if name in per_observation else each for name, each in inputs.items()}
    padded = dict(inputs)
    for name in per_observation:
        padded[name] = inputs[name].clone()
        padded[name][:, ~valid] = torch.nan if inputs[name].is_floating_point() else 1000
    found = bundle_adjust(**padded | {"valid": valid[None]})
    expected = bundle_adjust(**alone | {"valid": None})
    torch.testing.assert_close(found.T_cw, expected.T_cw, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.points, expected.points, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.chi2[:, valid], expected.chi2, rtol=1e-6, atol=1e-9)
    assert found.chi2[:, ~valid].isinf().all() and not found.inliers[:, ~valid].any()


@pytest.mark.parametrize("with_gradient", [False, True], ids=["kernel", "torch"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_observations_whose_pixel_is_not_finite_are_padding(value: float, with_gradient: bool) -> None:
    inputs = camera_inputs.calibration(2, OBSERVATIONS, torch.float64)
    readout = {name: inputs.pop(name) for name in ("seconds", "information", "readout_jacobian")}
    uv, weights = inputs["uv"].clone(), inputs["weights"].requires_grad_(with_gradient)
    uv[0, 8, 0], uv[1, 15] = value, -value
    finite = uv.isfinite().all(dim=-1)
    readout["readout_jacobian"][~finite] = torch.nan
    results = []
    for chosen in ({"uv": uv, "valid": None}, {"valid": finite}):
        adjusted = bundle_adjust(**inputs | chosen)
        state = {"T_cw": adjusted.T_cw, "points": adjusted.points}
        results.append((*adjusted, *estimate_readout(**readout, **inputs | state | chosen)))
        assert (adjusted.cost_after < adjusted.cost_before).all() and not adjusted.inliers[~finite].any()
        if with_gradient:
            results[-1] += torch.autograd.grad(results[-1][-2].sum() + adjusted.points.sum(), weights)
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other) and not one.isnan().any()


@pytest.mark.parametrize("value", [-1.0, torch.nan])
def test_weight_that_is_negative_or_nan_is_an_error(value: float) -> None:
    inputs = bundle() | {"valid": None}
    inputs["weights"][..., 3] = value
    with pytest.raises(InputError, match="weights has a value that is negative or NaN; give weights of at least 0"):
        bundle_adjust(**inputs)


def test_infinite_weight_is_an_error_unless_it_is_padding() -> None:
    inputs = bundle()
    inputs["weights"][:, 0] = torch.inf
    assert bundle_adjust(**inputs).cost_after.isfinite().all()
    inputs["weights"][:, 3] = torch.inf
    with pytest.raises(InputError, match="weights has an infinite value; give finite weights"):
        bundle_adjust(**inputs)


@pytest.mark.parametrize("name", ["inverse_depth", "weights", "valid", "fixed"])
def test_wrong_number_of_values_is_rejected(name: str) -> None:
    with pytest.raises(ShapeError):
        bundle_adjust(**bundle() | {name: torch.ones(7, dtype=torch.bool if name in ("valid", "fixed") else None)})


def test_transforms_give_the_gradient() -> None:
    inputs = bundle()
    uv = inputs.pop("uv")

    def loss(uv: Tensor) -> Tensor:
        return bundle_adjust(uv=uv, **inputs).points.square().sum()

    (expected,) = torch.autograd.grad(loss(uv.requires_grad_()), uv)
    torch.testing.assert_close(torch.func.grad(loss)(uv.detach()), expected, rtol=1e-5, atol=1e-8)


def test_gradients_of_the_readout_equal_finite_differences() -> None:
    inputs = camera_inputs.calibration(2, OBSERVATIONS, torch.float64)
    adjusted = bundle_adjust(**{name: inputs[name] for name in bundle(2)})
    state = {"T_cw": adjusted.T_cw, "points": adjusted.points}

    def readout(seconds: Tensor, jacobian: Tensor, uv: Tensor, weights: Tensor) -> Tensor:
        given = {"seconds": seconds, "readout_jacobian": jacobian, "uv": uv, "weights": weights}
        new_seconds, new_information = estimate_readout(**inputs | state | given)
        return torch.stack([100 * new_seconds, 1e-3 * new_information])

    arguments = (inputs[name] for name in ("seconds", "readout_jacobian", "uv", "weights"))
    assert check_gradients(readout, *arguments, step=1e-5)
