"""Least-squares problem of dense alignment on one pyramid level: brightness and inverse-depth residuals."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.long_products import sum_products
from v3d_torch.geometry.se3 import se3_exp, transform_points
from v3d_torch.odometry.dense_view import Level
from v3d_torch.optim.levenberg_marquardt import REGULARISATION
from v3d_torch.optim.robust_losses import student_t, student_t_scale

State = tuple[Tensor, Tensor]  # T_ba (4, 4); gain and bias from the reference's brightness to the current one's (2,)
System = tuple[Tensor, Tensor]  # J^T W J (8, 8) and J^T W r (8,) for xi in T_ba @ exp(xi), gain, bias

_DAMPING_SCALE = 1e3
"""Factor of the damping of Levenberg-Marquardt. The Jacobian of the reference only approximates that of the current
view; with less damping, the step after a rejected step is rejected, too."""

_OCCLUSION_RATIO = 0.1
"""Maximum relative difference between the inverse depth in the current view and the expected one. Beyond it a point is
occluded: the views show different surfaces, and their difference contains no information on the motion."""

_MIN_RESIDUALS = 50
"""Minimum number of valid residuals; with fewer, noise dominates the eight unknowns."""

_MIN_BRIGHTNESS_SIGMA = 1e-3
"""Minimum standard deviation of brightness: a quarter of an 8-bit step."""

_MIN_DEPTH = 0.1
"""Smallest depth of a point that is compared, metres, which keeps 1/z finite. RGB-D cameras measure no depth below it;
so the smaller limit of `v3d_torch.optim.reprojection` has the same effect."""

_GRADIENT_NOISE = 0.3
"""Variance of the noise of brightness gradients, divided by the squared scale of the residuals. The Sobel gradient
has 12/64 of a pixel's variance; the squared scale of a t-distribution with 5 degrees of freedom is 3/5 of its
variance."""


@dataclass(frozen=True)
class Residuals:
    """Residuals of M reference points in the current view.

    Attributes:
        values: Current minus expected brightness and inverse depth (1/m), float64, shape :math:`(2, M)`.
        valid: Mask of the residuals for which both views show the same surface, bool, shape :math:`(2, M)`.
        occluded: Mask of the points for which the current view shows another surface, bool, shape :math:`(M,)`.
        in_view: Mask of the points that lie on static pixels of the current view, bool, shape :math:`(M,)`.
    """

    values: Tensor
    valid: Tensor
    occluded: Tensor
    in_view: Tensor


class AlignmentProblem:
    """Least-squares problem of one pyramid level, with noise scales and Jacobian fixed at the initial state.

    Args:
        reference: Level of the reference view; its reference points are aligned.
        current: Level of the current view, into which the points are projected.
        initial_state: Motion ``T_ba``, gain and bias.
        inverse_depth_sigma: Minimum standard deviation of inverse depth, 1/m.
        config: Degrees of freedom of the t-distribution.
    """

    def __init__(
        self,
        reference: Level,
        current: Level,
        initial_state: State,
        inverse_depth_sigma: float,
        config: DenseOdometryConfig,
    ) -> None:
        self.reference, self._current = reference.reference_points, current
        self._degrees_of_freedom = config.degrees_of_freedom
        initial = self.residuals(initial_state)
        self._sigma = initial.values.new_tensor([[_MIN_BRIGHTNESS_SIGMA], [inverse_depth_sigma]])
        for sigma, values, valid in zip(self._sigma, initial.values, initial.valid, strict=True):
            if valid.any():
                sigma.clamp_(min=student_t_scale(values[valid].square(), config.degrees_of_freedom))
        brightness = self.reference.values[0]
        by_gain_and_bias = initial.values.new_zeros(2, len(self.reference.points), 2)
        by_gain_and_bias[0] = -torch.stack([brightness, torch.ones_like(brightness)], dim=-1)
        gain = initial_state[1][0]
        gains = torch.stack([gain, torch.ones_like(gain)])
        by_motion = gains[:, None, None] * self.reference.jacobian
        self._jacobian = torch.cat([by_motion, by_gain_and_bias], dim=-1).flatten(0, 1)

    def residuals(self, state: State) -> Residuals:
        """Compare the reference points with the current view."""
        T_ba, (gain, bias) = state[0].to(torch.float32), state[1].to(torch.float32)
        camera = self._current.level_camera.camera
        points = transform_points(T_ba, self.reference.points)
        in_front = points[:, 2] > _MIN_DEPTH
        pixels = camera.distort(camera.project(points.where(in_front[:, None], 1.0))).to(torch.float32)
        last = torch.tensor([camera.width - 1, camera.height - 1], device=pixels.device)
        in_image = in_front & ((pixels >= 0) & (pixels <= last)).all(dim=1)
        sampled = grid_sample(self._current.channels[None], (2 * pixels / last - 1)[None, None], align_corners=True)
        inverse_depth = 1 / points[:, 2]
        values = sampled[0, :, 0] - torch.stack([gain * self.reference.values[0] + bias, inverse_depth])
        known = values.isfinite() & in_image
        limit = _OCCLUSION_RATIO * inverse_depth
        occluded = known[1] & (values[1].abs() > limit)
        values[1] = values[1].clamp(-limit, limit)
        return Residuals(
            values=values.where(known, 0.0).to(torch.float64),
            valid=known & self.reference.usable & ~occluded,
            occluded=occluded,
            in_view=known[0],
        )

    def linearise(self, state: State) -> tuple[Tensor, System]:
        """Mean robust cost, infinite with too few valid residuals, and normal equations."""
        residuals = self.residuals(state)
        if int(residuals.valid.sum()) < _MIN_RESIDUALS:
            none = residuals.values.new_zeros(8, 8)
            return none.new_tensor(torch.inf), (none, none[0])
        costs, weights = student_t((residuals.values / self._sigma).square(), self._degrees_of_freedom)
        weights = (weights * residuals.valid / self._sigma.square()).flatten()
        weighted = self._jacobian * weights[:, None]
        # Occluded points have a constant cost; otherwise a motion that occludes outliers would lower the cost.
        counted = torch.stack([residuals.valid[0], residuals.valid[1] | residuals.occluded])
        gradient = sum_products(weighted, residuals.values.flatten()[:, None])[:, 0]
        return costs[counted].mean(), (sum_products(weighted, self._jacobian), gradient)

    def information(self, system: System, valid_brightness: Tensor) -> Tensor:
        """Information matrix of ``xi``, with gain and bias marginalised, shape (6, 6).

        Noise of the gradients has the effect of texture: motion along stripes would seem observable. The contribution
        of the noise is known from the residuals, and is subtracted. The result can be indefinite.

        Args:
            system: Normal equations.
            valid_brightness: Mask of the valid brightness residuals, bool, shape (M,).
        """
        H, _ = system
        pixel_jacobian = self.reference.pixel_jacobian[valid_brightness].flatten(0, 1).to(torch.float64)
        marginalised = H[:6, 6:] @ torch.linalg.pinv(H[6:, 6:], hermitian=True) @ H[6:, :6]
        return H[:6, :6] - marginalised - _GRADIENT_NOISE * sum_products(pixel_jacobian, pixel_jacobian)


def step(state: State, system: System, damping: Tensor) -> State:
    """State after a damped Gauss-Newton step."""
    H, gradient = system
    diagonal = _DAMPING_SCALE * damping * H.diagonal() + REGULARISATION
    change = -torch.linalg.solve(H + diagonal.diag(), gradient)
    return state[0] @ se3_exp(change[:6]), state[1] + change[6:]
