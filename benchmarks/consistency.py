"""Consistency of the covariance of poses with their errors, as Markdown.

``python benchmarks/consistency.py --seqs fr1_rpy crowd_rpy`` runs sequences and reports the normalised estimation error
squared (NEES; Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, Sec.
5.4.2) of the poses at each frame, without later corrections. Its expectation is the number of dimensions.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import columns
import numpy as np
import torch
from command import make_parser, publish
from contenders.ours import OPTIONS, Ours
from heading import make_heading
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2
from sequences import locate_sequence
from storage import Measurement, Row
from tables import flat
from torch import Tensor

from v3d_torch.datasets import load_sequence
from v3d_torch.errors import InputError, V3DError
from v3d_torch.geometry.se3 import adjoint, invert, se3_exp, se3_log
from v3d_torch.types import Trajectory

MAX_GAP = 0.05
"""Maximum time between two true poses for interpolation, seconds."""

ITERATIONS = 20
"""Number of Gauss-Newton steps of the calibration, which converges in a few."""

STEP = 1e-3
"""Time over which the true velocity is measured, seconds."""

CONFIDENCE = 0.95
"""Probability of the bounds."""


@dataclass(frozen=True)
class Errors:
    """Errors of poses, after the calibration of the ground truth.

    Attributes:
        xi: Error of each pose, see `CameraState`, float64, shape :math:`(N, 6)`.
        covariance: Covariance of each error, float64, shape :math:`(N, 6, 6)`.
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
    camera's poses.

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
    stamps, T_wc, covariance = stamps[kept], T_wc[kept], covariance[kept]
    information, T_cw = torch.linalg.inv(covariance), invert(T_wc)
    T_cb, delay = torch.eye(4, dtype=torch.float64), 0.0
    T_gw = interpolate(groundtruth, stamps[:1])[0] @ T_cw[0]
    for _ in range(ITERATIONS):
        T_gb = interpolate(groundtruth, stamps + delay)
        xi = se3_log(T_cw @ invert(T_gw) @ T_gb @ invert(T_cb))
        velocity = se3_log(invert(T_gb) @ interpolate(groundtruth, stamps + delay + STEP)) / STEP
        J = torch.cat(
            [
                -adjoint(T_cw),
                -torch.eye(6, dtype=torch.float64).expand(len(xi), 6, 6),
                adjoint(T_cb) @ velocity[..., None],
            ],
            dim=2,
        )
        weighted = J.mT @ information
        step = -torch.linalg.lstsq((weighted @ J).sum(dim=0), (weighted @ xi[..., None]).sum(dim=0)).solution[:, 0]
        T_gw, T_cb, delay = T_gw @ se3_exp(step[:6]), se3_exp(step[6:12]) @ T_cb, delay + float(step[12])
    T_gb = interpolate(groundtruth, stamps + delay)
    return Errors(se3_log(T_cw @ invert(T_gw) @ T_gb @ invert(T_cb)), covariance)


def interpolate(trajectory: Trajectory, stamps: Tensor) -> Tensor:
    """Interpolate poses at times within a trajectory, float64, shape :math:`(N, 4, 4)`."""
    known, times = trajectory.stamps.numpy(), stamps.numpy()
    T = torch.eye(4, dtype=torch.float64).repeat(len(times), 1, 1)
    rotation = Slerp(known, Rotation.from_matrix(trajectory.T_wc[:, :3, :3].numpy()))(times)
    T[:, :3, :3] = torch.from_numpy(rotation.as_matrix())
    for axis in range(3):
        T[:, axis, 3] = torch.from_numpy(np.interp(times, known, trajectory.T_wc[:, axis, 3].numpy()))
    return T


def make_row(sequence: str, configuration: str, errors: Errors) -> Row:
    """Return the row of a run."""
    nees = errors.nees(slice(0, 6))
    return {
        "sequence": sequence,
        "configuration": configuration,
        "poses": str(len(nees)),
        "nees": f"{nees.mean():.1f}",
        "median": f"{nees.median():.1f}",
        "position": f"{errors.nees(slice(0, 3)).mean():.1f}",
        "rotation": f"{errors.nees(slice(3, 6)).mean():.1f}",
        "within": f"{(nees < chi2.ppf(CONFIDENCE, 6)).double().mean():.0%}",
    }


def run(sequence: str, configuration: str, options: argparse.Namespace) -> Row:
    """Run a sequence and return its row.

    Raises:
        InputError: If there is no ground truth.
        V3DError: If the run fails.
    """
    source = load_sequence(locate_sequence(sequence, options.data_root), data_root=options.data_root)
    if source.groundtruth is None:
        raise InputError(f"{sequence}: has no ground truth; choose another sequence")
    contender = Ours(source, configuration, seed=0)
    contender()
    states = contender.pipeline.record.states
    T_wc = torch.eye(4, dtype=torch.float64).repeat(len(states), 1, 1)
    T_wc[:, :3] = states["T_wc"]
    errors = calibrated_errors(source.groundtruth, states["stamp"], T_wc, states["covariance"].to(torch.float64))
    return make_row(sequence, configuration, errors)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all sequences and print the table."""
    parser = make_parser("Consistency of the covariance of poses with their errors, as Markdown.")
    parser.add_argument("--seqs", nargs="+", default=["demo"], help="sequences with ground truth [demo]")
    parser.add_argument("--configuration", choices=OPTIONS, default="v3d_torch", help="configuration [v3d_torch]")
    options = parser.parse_args(arguments)
    heading = make_heading()
    try:
        rows = [run(name, options.configuration, options) for name in options.seqs]
    except V3DError as error:
        parser.error(str(error))
    lines = [*heading.lines(), "", *flat(rows, columns.CONSISTENCY)]
    publish(lines, options, parser, {"consistency": Measurement(heading, rows)})


if __name__ == "__main__":
    main()
