"""Recovery of a camera that was covered, lost frames, or was moved elsewhere, as Markdown.

``python benchmarks/lost.py --seqs demo fr1_rpy`` interrupts sequences and compares the result with the ground truth and
with the run without interruption. A place counts as known if the true camera is near a position before the
interruption and has nearly the same orientation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import columns
import torch
from command import add_sequences_option, make_parser, publish_rows
from interruptions import (
    COVERED,
    NO_POSITION,
    Case,
    InterruptedFrames,
    InterruptedMasks,
    covered,
    dropped,
    elsewhere,
    uninterrupted,
)
from sequences import table_name
from storage import Row
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import InputError
from v3d_torch.evaluation.association import associate_trajectories
from v3d_torch.evaluation.ate import absolute_errors, align
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import TrackingStatus, Trajectory

MAX_DISTANCE = 0.3
"""Maximum distance between two poses at the same place, metres."""

MAX_ANGLE = 0.26
"""Maximum angle between two poses at the same place, radians: 15 degrees, a quarter of the view of a Kinect."""

MAX_RECOVERY = 10
"""Maximum number of frames to recover, for a pass."""

MAX_RATIO = 1.5
"""Maximum ratio of the ATE to that of the run without interruption, for a pass."""

MAX_ERROR = 0.1
"""Maximum error of a reliable pose, for a pass, metres."""


@dataclass(frozen=True)
class Result:
    """Result of a run.

    Attributes:
        T_wc: Poses of all frames after all corrections, shape :math:`(N, 4, 4)`.
        online: Status of each frame when it was tracked.
        statuses: Status of each frame at the end.
    """

    T_wc: Tensor
    online: list[TrackingStatus]
    statuses: list[TrackingStatus]


def run_case(sequence: RGBDSequence, case: Case, config: Config, masks: Path | None) -> Result:
    """Run the system on a case; without masks, no object is masked."""
    set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    segment = NoSegmentation() if masks is None else InterruptedMasks(sequence, case, masks)
    slam = V3DSLAM(sequence.camera, segment, config)
    online = [slam(frame).status for frame in InterruptedFrames(sequence, case)]
    slam.flush()
    return Result(slam.poses.trajectory().T_wc, online, slam.poses.statuses)


@dataclass(frozen=True)
class Score:
    """Scores of a case.

    Attributes:
        recovery: Number of frames from the first frame at a known place to the first tracked frame; None if no place
            was known.
        unflagged: Number of covered frames with the status tracked.
        found: Fraction of the observed frames with a reliable pose.
        ate: RMSE over these frames, metres.
        reference: RMSE of the run without interruption over the same frames, metres.
        worst: Largest error of a reliable pose, metres.
        reference_worst: Largest error of the run without interruption over the same frames, metres.
    """

    recovery: float | None
    unflagged: int
    found: float
    ate: float
    reference: float
    worst: float
    reference_worst: float

    @property
    def passes(self) -> bool:
        """True if the camera recovered in time, with an ATE and a worst error below their limits."""
        in_time = self.recovery is None or self.recovery <= MAX_RECOVERY
        accurate = self.ate <= MAX_RATIO * self.reference and self.worst <= MAX_ERROR
        return in_time and not self.unflagged and accurate


def score(case: Case, result: Result, plain: Result, T_gc: Tensor) -> Score:
    """Compare a run with the ground truth.

    Args:
        case: Case that was run.
        result: Result of the run.
        plain: Result of the run without interruption, at least as long.
        T_gc: True poses of the frames of the sequence, see `true_poses`, shape :math:`(count, 4, 4)`.
    """
    shown, positions = torch.tensor(case.shown), torch.tensor(case.plain)
    truth = T_gc[shown.clamp(min=0)]
    observed = (shown != COVERED) & truth[:, 0, 3].isfinite()
    found = observed & torch.tensor([status.is_localised for status in result.statuses])
    common = found & (positions != NO_POSITION)
    errors = absolute_errors(truth, result.T_wc, align(truth[common], result.T_wc[common]))
    true, T_plain = truth[common], plain.T_wc[positions[common]]
    without = absolute_errors(true, T_plain, align(true, T_plain))
    return Score(
        recovery=recovery(case, result.online, truth),
        unflagged=sum(
            status is TrackingStatus.TRACKED
            for status, index in zip(result.statuses, case.shown, strict=True)
            if index == COVERED
        ),
        found=float(found.sum() / observed.sum()),
        ate=float(errors[common].square().mean().sqrt()),
        reference=float(without.square().mean().sqrt()),
        worst=float(errors[found].max()),
        reference_worst=float(without.max()),
    )


def recovery(case: Case, online: Sequence[TrackingStatus], truth: Tensor) -> float | None:
    """Return the number of frames from the first at a known place to the first tracked frame; inf if there is none."""
    difference = se3_log(invert(truth[: case.cut])[None] @ truth[case.back :, None])
    known = (difference[..., :3].norm(dim=-1) < MAX_DISTANCE) & (difference[..., 3:].norm(dim=-1) < MAX_ANGLE)
    places = known.any(dim=1).nonzero()[:, 0].tolist()
    if not places:
        return None
    tracked = [k for k in range(case.back, len(online)) if online[k] is TrackingStatus.TRACKED]
    return max(tracked[0] - case.back - places[0], 0) if tracked else torch.inf


def true_poses(sequence: RGBDSequence) -> Tensor:
    """Return the true camera-to-world poses of all frames; NaN if a frame has none.

    Raises:
        InputError: If there is no ground truth.
    """
    if sequence.groundtruth is None:
        raise InputError(f"{sequence.name}: has no ground truth; choose another sequence")
    T_gc = torch.full((len(sequence), 4, 4), torch.nan, dtype=torch.float64)
    matches = associate_trajectories(sequence.groundtruth, Trajectory(sequence.stamps, T_gc))
    T_gc[matches.estimate] = sequence.groundtruth.T_wc[matches.groundtruth]
    return T_gc


def measure(source: str, gaps: Sequence[int], before: int, after: int, with_masks: bool) -> Iterator[Row]:
    """Yield a row per interruption."""
    config = load_config(overrides=[f"segmentation.source={'masks' if with_masks else 'none'}"])
    masks = Path(source) / "masks" if with_masks else None
    sequence = load_sequence(source)
    count, T_gc = len(sequence), true_poses(sequence)
    plain = run_case(sequence, uninterrupted(count, before + max(gaps) + after), config, masks)
    cases = [make(count, before, gap, after) for make in (covered, dropped) for gap in gaps]
    for case in [*cases, elsewhere(count, before, after)]:
        scored = score(case, run_case(sequence, case, config, masks), plain, T_gc)
        yield {
            "sequence": table_name(sequence),
            "interruption": case.name,
            "recovery": "no known place" if scored.recovery is None else f"{scored.recovery:g}",
            "unflagged": str(scored.unflagged),
            "found": f"{scored.found:.0%}",
            "ate": f"{scored.ate:.4f}",
            "reference": f"{scored.reference:.4f}",
            "ratio": f"{scored.ate / scored.reference:.2f}",
            "worst": f"{scored.worst:.3f}",
            "reference_worst": f"{scored.reference_worst:.3f}",
            "passes": "yes" if scored.passes else "no",
        }


def main() -> None:
    """Run all cases and print the table."""
    parser = make_parser("Recovery of a camera that was covered, lost frames or was moved elsewhere, as Markdown.")
    add_sequences_option(parser, "ground truth")
    parser.add_argument(
        "--gaps", nargs="+", type=int, default=[30, 60, 150], help="frames covered or dropped [30 60 150]"
    )
    parser.add_argument("--before", type=int, default=90, help="number of frames before the interruption [90]")
    parser.add_argument("--after", type=int, default=60, help="number of frames after the interruption [60]")
    parser.add_argument("--masks", action="store_true", help="mask people with the true masks [no masks]")
    options = parser.parse_args()
    publish_rows(
        parser,
        options,
        "lost",
        columns.LOST | {"reference": "ATE uninterrupted, m"},
        lambda source: measure(source, options.gaps, options.before, options.after, options.masks),
    )


if __name__ == "__main__":
    main()
