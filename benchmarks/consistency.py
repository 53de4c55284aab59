"""Consistency of the covariance of poses with their errors, as Markdown.

``python benchmarks/consistency.py --seqs fr1_rpy crowd_rpy`` runs sequences and reports the normalised estimation error
squared (NEES; Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, Sec.
5.4.2) of the poses at each frame, without later corrections. Its expectation is the number of dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import columns
import numpy as np
import torch
from command import add_sequences_option, make_parser, publish_rows
from scipy.stats import chi2, norm
from sequences import table_name
from storage import Row
from systems.ours import OPTIONS, Ours
from torch import Tensor

from v3d_torch.datasets import load_sequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import adjoint, invert, se3_exp, se3_log
from v3d_torch.types import Trajectory

MAX_GAP = 0.05
"""Maximum time between two true poses for interpolation, seconds."""

FIRST = 40
"""Number of poses at the start whose NEES is given on its own: the first frames are processed before the motion of the
camera is known."""

ITERATIONS = 20
"""Number of Gauss-Newton steps of the calibration, which converges in a few."""

STEP = 1e-3
"""Time over which the true velocity is measured, seconds."""

CONFIDENCE = 0.95
"""Probability of the bounds."""

MAX_SMOOTH_STEP = 0.015
"""Longest median step of a ground truth whose noise is measured, seconds: within five such steps a hand moves smoothly,
so that what differs from a cubic polynomial is noise."""

DIFFERENCE = torch.tensor([1.0, -4.0, 6.0, -4.0, 1.0], dtype=torch.float64)
"""Weights of a fourth difference, which is 0 for a cubic polynomial."""


@dataclass(frozen=True)
class Errors:
    """Errors of poses, after the calibration of the ground truth.

    Attributes:
        xi: Error of each pose, see `CameraState`, float64, shape :math:`(N, 6)`.
        covariance: Covariance of each error, with that of the ground truth, float64, shape :math:`(N, 6, 6)`.
    """

    xi: Tensor
    covariance: Tensor

    def nees(self, dimensions: slice) -> Tensor:
        """NEES of some dimensions, float64, shape :math:`(N,)`."""
        xi, covariance = self.xi[:, dimensions], self.covariance[:, dimensions, dimensions]
        return (xi * torch.linalg.solve(covariance, xi)).sum(dim=1)


def calibrated_errors(groundtruth: Trajectory, stamps: Tensor, T_wc: Tensor, covariance: Tensor) -> Errors:
    """Errors of poses against a ground truth whose world, mounting and clock are calibrated.

    A motion capture system measures a body that is fixed to the camera, and it has its own clock: the estimate is
    compared with ``invert(T_gw) @ T_gb(stamp + delay) @ invert(T_cb)``. The two constant transforms and the delay are
    the maximum likelihood estimate for the given covariances, 13 numbers for all frames. They are not errors of the
    camera's poses. The noise of the ground truth is part of the covariance, see `groundtruth_noise`.

    Args:
        groundtruth: True poses.
        stamps: Times of the estimate, seconds, float64, shape :math:`(N,)`.
        T_wc: Estimate, float64, shape :math:`(N, 4, 4)`.
        covariance: Covariance of the estimate, see `CameraState`, float64, shape :math:`(N, 6, 6)`. Poses without
            uncertainty, such as the pose that defines the world, are left out.
    """
    true = groundtruth.stamps.numpy()
    gap = np.diff(true)[np.clip(np.searchsorted(true, stamps.numpy()) - 1, 0, len(true) - 2)]
    inside = (stamps > true[0] + MAX_GAP) & (stamps < true[-1] - MAX_GAP) & torch.from_numpy(gap < MAX_GAP)
    kept = inside & (torch.linalg.eigvalsh(covariance)[:, 0] > 0)
    if kept.sum() < ITERATIONS:
        raise InputError(f"{int(kept.sum())} poses have a covariance and a true pose; choose another sequence")
    stamps, T_cw, covariance = stamps[kept], invert(T_wc[kept]), covariance[kept]
    noise = groundtruth_noise(groundtruth).square().diag()
    T_cb, delay = torch.eye(4, dtype=torch.float64), 0.0
    T_gw = groundtruth.poses_at(stamps[:1])[0] @ T_cw[0]
    for _ in range(ITERATIONS):
        T_gb = groundtruth.poses_at(stamps + delay)
        xi = se3_log(T_cw @ invert(T_gw) @ T_gb @ invert(T_cb))
        velocity = se3_log(invert(T_gb) @ groundtruth.poses_at(stamps + delay + STEP)) / STEP
        J = torch.cat(
            [
                -adjoint(T_cw),
                -torch.eye(6, dtype=torch.float64).expand(len(xi), 6, 6),
                adjoint(T_cb) @ velocity[..., None],
            ],
            dim=2,
        )
        known = interpolated_variance(groundtruth, stamps + delay)[:, None, None]
        weighted = J.mT @ torch.linalg.inv(covariance + known * (adjoint(T_cb) @ noise @ adjoint(T_cb).mT))
        step = -torch.linalg.lstsq((weighted @ J).sum(dim=0), (weighted @ xi[..., None]).sum(dim=0)).solution[:, 0]
        T_gw, T_cb, delay = T_gw @ se3_exp(step[:6]), se3_exp(step[6:12]) @ T_cb, delay + float(step[12])
    T_gb = groundtruth.poses_at(stamps + delay)
    xi = se3_log(T_cw @ invert(T_gw) @ T_gb @ invert(T_cb))
    known = interpolated_variance(groundtruth, stamps + delay)[:, None, None]
    return Errors(xi, covariance + known * (adjoint(T_cb) @ noise @ adjoint(T_cb).mT))


def groundtruth_noise(groundtruth: Trajectory) -> Tensor:
    """Standard deviations of the independent noise of true poses, metres and radians, float64, shape :math:`(6,)`.

    It is measured by fourth differences of the poses (Hall, Kay and Titterington, Biometrika 1990), of which the median
    counts, because a motion capture system jumps at times. Errors that stay the same for longer are not measured. 0 if
    the poses are too far apart, as those of simulated cameras and of composed sequences.
    """
    stamps, T_wb = groundtruth.stamps, groundtruth.T_wc
    if len(stamps) < ITERATIONS or float(stamps.diff().median()) > MAX_SMOOTH_STEP:
        return torch.zeros(6, dtype=torch.float64)
    windows = torch.stack([T_wb[k : len(T_wb) - 4 + k] for k in range(5)], dim=1)
    xi = se3_log(invert(windows[:, 2:3]) @ windows)
    return (DIFFERENCE @ xi).abs().median(dim=0).values / (norm.ppf(0.75) * DIFFERENCE.norm())


def mean_bounds(nees: Tensor) -> tuple[float, float]:
    """Bounds of the mean NEES of consistent poses.

    Errors of consecutive poses are alike, so that their mean varies as that of fewer independent ones. Their number
    follows from the autocorrelation of the NEES, summed up to its first negative value (Geyer, Statistical Science
    1992).

    Args:
        nees: NEES of consecutive poses, float64, shape :math:`(N,)`.
    """
    centred, count = nees - nees.mean(), len(nees)
    correlations = torch.stack([centred[: count - lag] @ centred[lag:] for lag in range(count)]) / (centred @ centred)
    positive = (correlations > 0).long().cumprod(dim=0).bool()
    independent = count / float(2 * correlations[positive].sum() - 1)
    low, high = (chi2.ppf((1 + sign * CONFIDENCE) / 2, 6 * independent) / independent for sign in (-1, 1))
    return float(low), float(high)


def interpolated_variance(trajectory: Trajectory, stamps: Tensor) -> Tensor:
    """Variance of interpolated poses relative to that of known ones with independent noise, float64, shape (N,)."""
    after = torch.searchsorted(trajectory.stamps, stamps).clamp(1, len(trajectory.stamps) - 1)
    first, last = trajectory.stamps[after - 1], trajectory.stamps[after]
    fraction = (stamps - first) / (last - first)
    return fraction.square() + (1 - fraction).square()


def make_row(sequence: str, configuration: str, errors: Errors, sigmas: Tensor) -> Row:
    """Return the row of a run, given the noise of its ground truth (see `groundtruth_noise`)."""
    nees = errors.nees(slice(0, 6))
    low, high = mean_bounds(nees)
    position, rotation = (1e3 * float(each.square().mean().sqrt()) for each in sigmas.split(3))
    return {
        "sequence": sequence,
        "configuration": configuration,
        "poses": str(len(nees)),
        "nees": f"{nees.mean():.1f}",
        "bounds": f"{low:.1f} to {high:.1f}",
        "median": f"{nees.median():.1f}",
        "position": f"{errors.nees(slice(0, 3)).mean():.1f}",
        "rotation": f"{errors.nees(slice(3, 6)).mean():.1f}",
        "within": f"{(nees < chi2.ppf(CONFIDENCE, 6)).double().mean():.0%}",
        "first": f"{nees[:FIRST].mean():.1f}",
        "groundtruth": f"{position:.1f} mm, {rotation:.1f} mrad" if position else "not measured",
    }


def run(source: str, configuration: str) -> Row:
    """Run a sequence and return its row.

    Args:
        source: Sequence as `load_sequence` takes it.
        configuration: One of `OPTIONS`.

    Raises:
        InputError: If there is no ground truth.
        V3DError: If the run fails.
    """
    sequence = load_sequence(source)
    if sequence.groundtruth is None:
        raise InputError(f"{source}: has no ground truth; choose another sequence")
    system = Ours(sequence, configuration, seed=0)
    system()
    states = system.pipeline.record.states
    T_wc = torch.eye(4, dtype=torch.float64).repeat(len(states), 1, 1)
    T_wc[:, :3] = states["T_wc"]
    errors = calibrated_errors(sequence.groundtruth, states["stamp"], T_wc, states["covariance"].to(torch.float64))
    return make_row(table_name(sequence), configuration, errors, groundtruth_noise(sequence.groundtruth))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all sequences and print the table."""
    parser = make_parser("Consistency of the covariance of poses with their errors, as Markdown.")
    add_sequences_option(parser, "ground truth")
    parser.add_argument("--configuration", choices=OPTIONS, default="v3d_torch", help="configuration [v3d_torch]")
    options = parser.parse_args(arguments)
    publish_rows(
        parser, options, "consistency", columns.CONSISTENCY, lambda source: [run(source, options.configuration)]
    )


if __name__ == "__main__":
    main()
