r"""Online calibration of the rolling-shutter readout from the cost of local bundle adjustment.

A wrong readout distorts the images of a rotating camera. A map with the same distortion explains these images equally
well, until the camera rotates in another direction. Calibration therefore uses the cost after all poses and points
are adjusted again, as a function of the readout. Near the current readout this cost is a parabola: its minimum is an
estimate of the readout, and its curvature is the information of that estimate.
"""

from __future__ import annotations

import torch
from torch import Tensor

from v3d_torch.errors import InputError
from v3d_torch.geometry.argument_checks import check_positive
from v3d_torch.geometry.camera import MAX_READOUT
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.kernels import bundle_adjustment as kernels
from v3d_torch.kernels.compiler import can_read, compiled_by
from v3d_torch.mapping.bundle_adjustment import sort_by_point
from v3d_torch.mapping.bundle_problem import NEGLIGIBLE_DAMPING, BundleProblem, prepare_bundle
from v3d_torch.optim.reprojection import INVERSE_DEPTH_SIGMA, MIN_DEPTH
from v3d_torch.optim.schur import SCHUR_REGULARISATION
from v3d_torch.runtime.batches import check_shapes, fill_padding, from_rows, to_rows

_PRIOR_WEIGHT = 0.85
"""Weight of the earlier information: the first bundle adjustments have the least accurate camera motion."""

_INFORMATION_WEIGHT = 0.03
"""Weight of the information from the curvature, for standard deviations that are six times larger. The curvature
overestimates the information, because errors of depth and velocity are correlated between observations, and successive
bundle adjustments share most observations."""

_MIN_CURVATURE = 1e-6
"""Minimum curvature of a minimum, as a fraction of the curvature without adjustment of poses and points. A smaller
curvature is due to rounding and damping: poses and points explain every readout."""


def estimate_readout(
    seconds: Tensor | float,
    information: Tensor | float,
    readout_jacobian: Tensor,
    T_cw: Tensor,
    points: Tensor,
    uv: Tensor,
    pose: Tensor,
    point: Tensor,
    K: Tensor,
    inverse_depth: Tensor | None = None,
    pixel_sigma: Tensor | float = 1.0,
    inverse_depth_sigma: Tensor | float = INVERSE_DEPTH_SIGMA,
    fixed: Tensor | None = None,
    weights: Tensor | None = None,
    valid: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Improve an estimate of the readout, the time that a camera takes to read the rows of an image.

    The adjusted observations were compensated with the earlier estimate. A linear step predicts how poses and
    landmarks, and so the minimum cost, would change with the readout. The predicted cost is a parabola. Its minimum is
    combined with the earlier estimate, which is discounted, because successive adjustments share observations.

    Differentiable in all inputs. The method is this project's; cf. Hedborg et al., Rolling Shutter Bundle Adjustment,
    CVPR 2012.

    Args:
        seconds: Earlier estimate of the time from the first to the last row, seconds, for which ``uv`` was compensated,
            a number or shape :math:`(*)`.
        information: Inverse variance of ``seconds``, 1/s^2, a number or shape :math:`(*)`; infinite if the readout is
            known.
        readout_jacobian: Derivatives of ``uv`` with respect to the readout, pixels per second, shape :math:`(*, M, 2)`;
            see :func:`compensate_rolling_shutter`.
        T_cw: Poses at the minimum of the bundle adjustment, shape :math:`(*, P, 4, 4)`. These and all other arguments
            are those of :func:`bundle_adjust`.
        points: Landmarks at the minimum, world frame, metres, shape :math:`(*, L, 3)`.
        uv: Observed pixels, undistorted, shape :math:`(*, M, 2)`.
        pose: Index of the pose from which each observation was made, int64, shape :math:`(*, M)`.
        point: Index of the observed landmark, int64, shape :math:`(*, M)`.
        K: Camera matrix, shape :math:`(*, 3, 3)`.
        inverse_depth: Inverse of the measured depth, 1/m, shape :math:`(*, M)`; 0, NaN or infinite = not measured.
            None if no depth was measured.
        pixel_sigma: Standard deviation of u and of v, pixels, a number or shape :math:`(*, M)`.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m, a number or shape :math:`(*, M)`.
        fixed: Mask of the poses that stayed unchanged, bool, shape :math:`(*, P)`; None for only the first.
        weights: Weight of each observation, not negative, shape :math:`(*, M)`; None for 1.
        valid: Mask of the observations that are not padding, bool, shape :math:`(*, M)`; None for all. An observation
            whose pixel is not finite counts as padding.

    Returns:
        The new ``seconds``, with the dtype of ``T_cw``, float32 for integers, and ``information``, at least in float32,
        shape :math:`(*)` each. They equal the inputs if the readout is known, or if the cost has no minimum because the
        camera stood still, or because other poses and landmarks explain every readout equally well. After a nearly
        uniform motion, ``seconds`` stays nearly the same and ``information`` is discounted.

    Raises:
        InputError: If ``pose`` or ``point`` is not int64, or has an index out of range, if a mask is not bool, if a
            pose or landmark is not finite, if a weight is negative, infinite or NaN, if a standard deviation in a
            tensor is not positive, if ``K`` is not the matrix of a pinhole camera, or if ``information`` is negative or
            NaN.
        ConfigError: If a standard deviation that is a number is not positive.
    """
    old_information = torch.as_tensor(information, dtype=torch.float64, device=uv.device)
    if can_read(old_information) and not bool((old_information >= 0).all()):
        raise InputError("information has a value that is negative or NaN; give inverse variances of at least 0")
    batch = check_shapes(
        seconds=(seconds,),
        information=(information,),
        readout_jacobian=(readout_jacobian, "M", 2),
        T_cw=(T_cw, "P", 4, 4),
        points=(points, "L", 3),
        uv=(uv, "M", 2),
    )
    T_cw = T_cw.expand(*batch, *T_cw.shape[-3:])
    problem, state, valid = prepare_bundle(
        T_cw, points, uv, pose, point, K, inverse_depth, pixel_sigma, inverse_depth_sigma, fixed, weights, valid
    )
    sigma = fill_padding(pixel_sigma, valid, 1.0)[..., None] if isinstance(pixel_sigma, Tensor) else pixel_sigma
    derivative = -fill_padding(readout_jacobian, valid[..., None], 0.0) / sigma
    by_readout = torch.cat([derivative, torch.zeros_like(derivative[..., :1])], dim=-1).mT.expand_as(problem.scale)
    slope, curvature = reduced_cost_derivatives(*state, by_readout, *problem)
    unadjusted = 2 * (problem.weights[..., None, :] * by_readout.square()).sum(dim=(-2, -1))
    old_seconds = torch.as_tensor(seconds, dtype=torch.float64, device=uv.device)
    estimates = torch.broadcast_tensors(old_seconds, old_information, slope, curvature, unadjusted)
    new_seconds, new_information = combine_readouts(*estimates)
    return new_seconds.to(result_dtype(T_cw.dtype)), new_information.to(working_dtype(T_cw.dtype))


def combine_readouts(
    seconds: Tensor, information: Tensor, slope: Tensor, curvature: Tensor, unadjusted_curvature: Tensor
) -> tuple[Tensor, Tensor]:
    """Combine an estimate of the readout with the minimum of the cost.

    Args:
        seconds: Readout at which the cost was differentiated, shape :math:`(...)`.
        information: Inverse variance of ``seconds``, 1/s^2, shape :math:`(...)`.
        slope: First derivative of the cost, twice the negative log-likelihood, with respect to the readout, shape
            :math:`(...)`.
        curvature: Second derivative of the cost with respect to the readout, shape :math:`(...)`.
        unadjusted_curvature: Second derivative with poses and points that stay unchanged, shape :math:`(...)`.

    Returns:
        Seconds and information of the combination; those given if the cost has no minimum.
    """
    unchanged = information.isinf() | (curvature <= _MIN_CURVATURE * unadjusted_curvature)
    # torch.where evaluates both branches: the 1 keeps the unused branch and its gradient finite.
    curvature, prior_information = torch.where(unchanged, 1.0, curvature), torch.where(unchanged, 1.0, information)
    minimum = (seconds - slope / curvature).clamp(-MAX_READOUT, MAX_READOUT)
    old, new = _PRIOR_WEIGHT * prior_information, _INFORMATION_WEIGHT * curvature / 2
    combined = (old * seconds + new * minimum) / (old + new)
    return torch.where(unchanged, seconds, combined), torch.where(unchanged, information, old + new)


def _reduced_cost_derivatives_compiled(
    T_cw: Tensor, points: Tensor, derivative: Tensor, *columns: Tensor
) -> tuple[Tensor, Tensor]:
    batch = T_cw.shape[:-3]
    if 0 in batch:
        return NotImplemented
    problems = sort_by_point(BundleProblem(*columns), points.shape[-2])
    poses, landmarks, derivatives = to_rows(T_cw, batch), to_rows(points, batch), to_rows(derivative.mT, batch)
    settings = NEGLIGIBLE_DAMPING, SCHUR_REGULARISATION, MIN_DEPTH
    results = [
        kernels.reduced_cost_derivatives(T, X, *arguments, j[order], *settings)
        for T, X, j, (order, arguments) in zip(poses, landmarks, derivatives, problems, strict=True)
    ]
    slope, curvature = from_rows(results, batch)
    return slope, curvature


@compiled_by(_reduced_cost_derivatives_compiled)
def reduced_cost_derivatives(
    T_cw: Tensor, points: Tensor, derivative: Tensor, *columns: Tensor
) -> tuple[Tensor, Tensor]:
    """Derivatives of the minimum cost of a bundle adjustment with respect to a parameter of the measurements.

    Poses and points are adjusted again when the parameter changes, see `BundleProblem.remaining`.

    Args:
        T_cw: Poses at the minimum, float64, shape :math:`(..., P, 4, 4)`.
        points: Landmarks at the minimum, float64, shape :math:`(..., L, 3)`.
        derivative: Derivative :math:`j` of the whitened residuals, shape :math:`(..., 3, M)`.
        columns: Columns of the `BundleProblem`.

    Returns:
        First and second derivative of the minimum cost, shape :math:`(...)` each.
    """
    problem = BundleProblem(*columns)
    _, residuals = problem.residuals_at((T_cw, points))
    weighted = 2 * residuals.weights[..., None, :] * problem.remaining(residuals, derivative, points.shape[-2])
    return (weighted * residuals.whitened).sum(dim=(-2, -1)), (weighted * derivative).sum(dim=(-2, -1))


class ReadoutEstimator(SettingsModule):
    """:func:`estimate_readout` as a module. Standard deviations that are a `torch.nn.Parameter` can be learned.

    Args:
        pixel_sigma: Standard deviation of u and of v, pixels.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m.

    Raises:
        ConfigError: If a number is not possible; see :func:`estimate_readout`.
    """

    def __init__(
        self, pixel_sigma: Tensor | float = 1.0, inverse_depth_sigma: Tensor | float = INVERSE_DEPTH_SIGMA
    ) -> None:
        check_positive(pixel_sigma=pixel_sigma, inverse_depth_sigma=inverse_depth_sigma)
        super().__init__()
        self.pixel_sigma = pixel_sigma
        self.inverse_depth_sigma = inverse_depth_sigma

    def forward(
        self,
        seconds: Tensor | float,
        information: Tensor | float,
        readout_jacobian: Tensor,
        T_cw: Tensor,
        points: Tensor,
        uv: Tensor,
        pose: Tensor,
        point: Tensor,
        K: Tensor,
        inverse_depth: Tensor | None = None,
        fixed: Tensor | None = None,
        weights: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Improve readouts, shape :math:`(*)`, by M observations; see :func:`estimate_readout`."""
        observed = uv, pose, point, K, inverse_depth, self.pixel_sigma, self.inverse_depth_sigma
        return estimate_readout(seconds, information, readout_jacobian, T_cw, points, *observed, fixed, weights, valid)
