"""The least-squares problem of dense alignment on one level: differences of brightness and of inverse depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from v3d_torch.config import DenseOdometryConfig
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.odometry.dense_view import Level
from v3d_torch.optim.levenberg_marquardt import student_t, student_t_scale

State = tuple[Tensor, Tensor]  # T_ba (4, 4); gain and bias from the reference's brightness to the current one's (2,)
System = tuple[Tensor, Tensor]  # J^T W J (8, 8) and J^T W r (8,) for xi in T_ba @ exp(xi), gain, bias


@dataclass(frozen=True)
class Comparison:
    """Reference against current view.

    Attributes:
        residuals: current minus expected brightness and inverse depth, float64, shape :math:`(2, M)`.
        compared: where both views show one surface, bool, shape :math:`(2, M)`.
        hidden: points where the current view shows another surface, bool, shape :math:`(M,)`.
        seen: points that lie in the current view on what stands still, bool, shape :math:`(M,)`.
    """

    residuals: Tensor
    compared: Tensor
    hidden: Tensor
    seen: Tensor


class Problem:
    """The least-squares problem of one level. Noise and Jacobian are those at its start.

    Args:
        reference: gives the points.
        current: where they are looked up.
        start: motion, gain and bias.
        inverse_depth_sigma: least standard deviation of inverse depth, 1/m.
        config: what hides, and the tails of the noise.
    """

    _LEAST = 50  # comparisons: from fewer, eight unknowns are noise
    _BRIGHTNESS_SIGMA = 1e-3  # least standard deviation: a quarter of a step of 8 bits
    _NEAREST = 0.1  # metres: no camera sees nearer, and 1/z stays finite
    # Of a pixel's variance, Sobel's gradient has 12/64; the scale of a t-distribution is 3/4 of the variance it fits.
    _GRADIENT_NOISE = 0.3

    def __init__(
        self, reference: Level, current: Level, start: State, inverse_depth_sigma: float, config: DenseOdometryConfig
    ) -> None:
        self.anchors, self._current, self._config = reference.anchors, current, config
        first = self.compare(start)
        self._sigma = torch.tensor([[self._BRIGHTNESS_SIGMA], [inverse_depth_sigma]], dtype=torch.float64)
        for sigma, residuals, compared in zip(self._sigma, first.residuals, first.compared, strict=True):
            if compared.any():
                sigma.clamp_(min=student_t_scale(residuals[compared].square(), config.degrees_of_freedom))
        by_light = torch.zeros(2, len(self.anchors.points), 2, dtype=torch.float64)
        by_light[0] = -torch.stack([self.anchors.values[0], torch.ones_like(self.anchors.values[0])], dim=-1)
        gains = torch.stack([start[1][0], torch.ones_like(start[1][0])])
        self._jacobian = torch.cat([gains[:, None, None] * self.anchors.slopes, by_light], dim=-1).flatten(0, 1)

    def compare(self, state: State) -> Comparison:
        """Look up the reference's points in the current view."""
        T_ba, (gain, bias) = state[0].to(torch.float32), state[1].to(torch.float32)
        camera = self._current.lens.camera
        points = self.anchors.points @ T_ba[:3, :3].T + T_ba[:3, 3]
        in_front = points[:, 2] > self._NEAREST
        pixels = camera.distort(camera.project(points.where(in_front[:, None], 1.0))).to(torch.float32)
        last = torch.tensor([camera.width - 1, camera.height - 1])
        in_view = in_front & ((pixels >= 0) & (pixels <= last)).all(dim=1)
        there = grid_sample(self._current.channels[None], (2 * pixels / last - 1)[None, None], align_corners=True)
        inverse = 1 / points[:, 2]
        residuals = there[0, :, 0] - torch.stack([gain * self.anchors.values[0] + bias, inverse])
        known = residuals.isfinite() & in_view
        limit = self._config.occlusion * inverse
        hidden = known[1] & (residuals[1].abs() > limit)
        residuals[1] = residuals[1].clamp(-limit, limit)
        return Comparison(
            residuals=residuals.where(known, 0.0).to(torch.float64),
            compared=known & self.anchors.usable & ~hidden,
            hidden=hidden,
            seen=known[0],
        )

    def linearise(self, state: State) -> tuple[float, System]:
        """Mean robust cost, infinite where there is too little to compare, and normal equations."""
        now = self.compare(state)
        if int(now.compared.sum()) < self._LEAST:
            return torch.inf, (torch.zeros(8, 8, dtype=torch.float64), torch.zeros(8, dtype=torch.float64))
        costs, weights = student_t((now.residuals / self._sigma).square(), self._config.degrees_of_freedom)
        weights = (weights * now.compared / self._sigma.square()).flatten()
        weighted = (self._jacobian * weights[:, None]).T
        # A hidden point costs as much as one about to be: else a motion could gain by hiding what disagrees.
        counted = torch.stack([now.compared[0], now.compared[1] | now.hidden])
        return float(costs[counted].mean()), (weighted @ self._jacobian, weighted @ now.residuals.flatten())

    def information(self, system: System, lit: Tensor) -> Tensor:
        """What is known of ``xi``, gain and bias marginalised, (6, 6).

        Noise in gradients looks like texture: on stripes it would claim to know the motion along them. It has been
        measured, as it makes up the residuals, and is taken off. What remains may be indefinite.
        """
        H, _ = system
        flow = self.anchors.flow[lit].flatten(0, 1).to(torch.float64)
        by_light = H[:6, 6:] @ torch.linalg.pinv(H[6:, 6:], hermitian=True) @ H[6:, :6]
        return H[:6, :6] - by_light - self._GRADIENT_NOISE * (flow.T @ flow)


def step(state: State, system: System, damping: float) -> State:
    """The state after a damped Gauss-Newton step."""
    H, gradient = system
    # The slopes are the reference's, not quite the current view's: with less damping a step that failed fails again.
    diagonal = 1e3 * damping * H.diagonal() + 1e-9  # solvable even where nothing is seen
    change = -torch.linalg.solve(H + diagonal.diag(), gradient)
    return state[0] @ se3_exp(change[:6]), state[1] + change[6:]
