"""How a camera that was covered, dropped frames, or was elsewhere finds itself again, as Markdown.

``python benchmarks/lost.py --seqs demo fr1_rpy`` interrupts sequences after a while and compares what is found with the
ground truth, and with the run that is not interrupted. A place is known once the true camera is near to where it was
before the interruption, and looks nearly the same way.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from command import command_line, publish
from heading import heading
from replay import forth_and_back
from sequences import located
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.errors import InputError, V3DError
from v3d_torch.evaluation.association import associate_trajectories
from v3d_torch.evaluation.ate import absolute_errors, align
from v3d_torch.evaluation.tables import row
from v3d_torch.geometry.se3 import invert, se3_log
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import MaskFolder, NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus, Trajectory

COVERED = NOWHERE = -1
"""Stands in the place of a frame that shows nothing, of a position that there is not."""

AWAY = 30
"""Frames that a camera is elsewhere."""

NEAR = 0.3
"""Metres from a pose before the interruption to one that sees the same place."""

ALIKE = 0.26
"""Radians between them: 15 degrees, a quarter of what a Kinect sees."""

FOUND = (TrackingStatus.TRACKED, TrackingStatus.ODOMETRY)
"""Statuses of a pose that is claimed to be right; the others say that it may be wrong."""


@dataclass(frozen=True)
class Case:
    """A way through a sequence.

    Attributes:
        name: of the interruption.
        shown: index of the frame that is shown, or `COVERED`.
        beats: when, counted in frames of the sequence.
        plain: position of the same frame in the run without interruption; `NOWHERE` where it has none.
        cut: position in ``shown`` of the first frame that is not as it should be.
        back: position of the first that is again.
    """

    name: str
    shown: list[int]
    beats: list[int]
    plain: list[int]
    cut: int
    back: int


def covered(count: int, before: int, gap: int, after: int) -> Case:
    """Nothing is seen for a while."""
    shown = forth_and_back(count, before + gap + after)
    shown[before : before + gap] = gap * [COVERED]
    positions = list(range(len(shown)))
    return Case(f"{gap} covered", shown, positions, positions, before, before + gap)


def dropped(count: int, before: int, gap: int, after: int) -> Case:
    """Frames are missing."""
    shown, positions = forth_and_back(count, before + gap + after), list(range(before + gap + after))
    del shown[before : before + gap], positions[before : before + gap]
    return Case(f"{gap} dropped", shown, positions, positions, before, before)


def elsewhere(count: int, before: int, after: int) -> Case:
    """The camera is in another part of the sequence from one frame to the next, and back from one to the next."""
    way = forth_and_back(count, before + after)
    first = max(count - AWAY, 0)
    shown = [*way[:before], *(first + index for index in forth_and_back(count - first, AWAY)), *way[before:]]
    plain = [*range(before), *(AWAY * [NOWHERE]), *range(before, before + after)]
    return Case(f"{AWAY} elsewhere", shown, list(range(len(shown))), plain, before, before + AWAY)


def uninterrupted(count: int, frames: int) -> Case:
    """As it is."""
    positions = list(range(frames))
    return Case("none", forth_and_back(count, frames), positions, positions, frames, frames)


class Way:
    """Frames of a sequence as a case shows them, at the sequence's pace."""

    def __init__(self, sequence: RGBDSequence, case: Case) -> None:
        self._sequence, self._shown = sequence, case.shown
        self.stamps = sequence.stamps[0] + sequence.stamps.diff().median() * torch.tensor(case.beats)

    def __iter__(self) -> Iterator[RGBDFrame]:
        for index, shown in enumerate(self._shown):
            frame = self._sequence[max(shown, 0)]
            if shown == COVERED:  # a finger glows
                frame = replace(frame, image=torch.full_like(frame.image, 3), depth=torch.zeros_like(frame.depth))
            yield replace(frame, index=index, stamp=float(self.stamps[index]))


class MaskedWay:
    """The stored masks of a sequence's frames, for those of a way."""

    def __init__(self, sequence: RGBDSequence, case: Case, folder: Path) -> None:
        self._sequence, self._shown, self._stored = sequence, case.shown, MaskFolder(folder)

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Instances of the frame that is shown."""
        shown = self._shown[frame.index]
        if shown == COVERED:
            return Instances.empty(*frame.image.shape[-2:])
        return self._stored(replace(frame, index=shown, stamp=float(self._sequence.stamps[shown])))


@dataclass(frozen=True)
class Result:
    """A run along a way.

    Attributes:
        T_wc: of every frame, after all corrections, shape :math:`(N, 4, 4)`.
        online: statuses when each frame had been taken in.
        statuses: at the end.
    """

    T_wc: Tensor
    online: list[TrackingStatus]
    statuses: list[TrackingStatus]


def follow(sequence: RGBDSequence, case: Case, config: Config, masks: Path | None) -> Result:
    """Run a case; without masks nobody is left out."""
    set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    segment = NoSegmentation() if masks is None else MaskedWay(sequence, case, masks)
    slam = V3DSLAM(sequence.camera, segment, config)
    online = [slam(frame).status for frame in Way(sequence, case)]
    return Result(slam.poses.trajectory().T_wc, online, slam.poses.statuses)


@dataclass(frozen=True)
class Score:
    """What became of an interruption.

    Attributes:
        recovery: frames from the first that shows a known place to the first in the map; None where none was seen.
        unflagged: frames in between that are claimed to be tracked in the map.
        found: share of the frames shown that are found.
        ate: RMSE over the frames found, metres.
        reference: of the run without interruption on the same frames.
        worst: largest error of a frame found, metres.
        reference_worst: of the run without interruption on the same frames.
    """

    recovery: float | None
    unflagged: int
    found: float
    ate: float
    reference: float
    worst: float
    reference_worst: float

    @property
    def holds(self) -> bool:
        """Found within 10 frames, flagged in between, as accurate as 1.5 times without, no wrong pose above 0.1 m."""
        soon = self.recovery is None or self.recovery <= 10
        return soon and not self.unflagged and self.ate <= 1.5 * self.reference and self.worst <= 0.1


def score(case: Case, result: Result, plain: Result, T_gc: Tensor) -> Score:
    """Compare a run with the truth.

    Args:
        case: that was run.
        result: of the run.
        plain: of the run without interruption, at least as long.
        T_gc: true poses of the frames of the sequence, see `true_poses`, shape :math:`(count, 4, 4)`.
    """
    shown, positions = torch.tensor(case.shown), torch.tensor(case.plain)
    truth = T_gc[shown.clamp(min=0)]
    seen = (shown != COVERED) & truth[:, 0, 3].isfinite()
    found = seen & torch.tensor([status in FOUND for status in result.statuses])
    both = found & (positions != NOWHERE)
    errors = absolute_errors(truth, result.T_wc, align(truth[both], result.T_wc[both]))
    true, T_plain = truth[both], plain.T_wc[positions[both]]
    without = absolute_errors(true, T_plain, align(true, T_plain))
    return Score(
        recovery=recovery(case, result.online, truth),
        unflagged=sum(
            status is TrackingStatus.TRACKED
            for status, index in zip(result.statuses, case.shown, strict=True)
            if index == COVERED
        ),
        found=float(found.sum() / seen.sum()),
        ate=float(errors[both].square().mean().sqrt()),
        reference=float(without.square().mean().sqrt()),
        worst=float(errors[found].max()),
        reference_worst=float(without.max()),
    )


def recovery(case: Case, online: Sequence[TrackingStatus], truth: Tensor) -> float | None:
    """Frames from the first after the interruption that shows a known place to the first tracked; inf for never."""
    apart = se3_log(invert(truth[: case.cut])[None] @ truth[case.back :, None])
    known = (apart[..., :3].norm(dim=-1) < NEAR) & (apart[..., 3:].norm(dim=-1) < ALIKE)
    places = known.any(dim=1).nonzero()[:, 0].tolist()
    if not places:
        return None
    tracked = [k for k in range(case.back, len(online)) if online[k] is TrackingStatus.TRACKED]
    return max(tracked[0] - case.back - places[0], 0) if tracked else torch.inf


def true_poses(sequence: RGBDSequence) -> Tensor:
    """Of every frame, camera to world; NaN where there is none.

    Raises:
        InputError: there is no ground truth.
    """
    if sequence.groundtruth is None:
        raise InputError(f"{sequence.name}: has no ground truth; name another sequence")
    T_gc = torch.full((len(sequence), 4, 4), torch.nan, dtype=torch.float64)
    matches = associate_trajectories(sequence.groundtruth, Trajectory(sequence.stamps, T_gc))
    T_gc[matches.estimate] = sequence.groundtruth.T_wc[matches.groundtruth]
    return T_gc


def table(
    sequence: RGBDSequence, gaps: Sequence[int], before: int, after: int, config: Config, masks: Path | None
) -> Iterator[str]:
    """A row per interruption."""
    count, T_gc = len(sequence), true_poses(sequence)
    plain = follow(sequence, uninterrupted(count, before + max(gaps) + after), config, masks)
    cases = [make(count, before, gap, after) for make in (covered, dropped) for gap in gaps]
    for case in [*cases, elsewhere(count, before, after)]:
        scored = score(case, follow(sequence, case, config, masks), plain, T_gc)
        yield row(
            [
                *(sequence.name, case.name),
                "none seen" if scored.recovery is None else f"{scored.recovery:g}",
                *(str(scored.unflagged), f"{scored.found:.0%}", f"{scored.ate:.4f}", f"{scored.reference:.4f}"),
                *(
                    f"{scored.ate / scored.reference:.2f}",
                    f"{scored.worst:.3f}",
                    f"{scored.reference_worst:.3f}",
                    "yes" if scored.holds else "no",
                ),
            ]
        )


COLUMNS = (
    *("sequence", "interruption", "frames to recover", "covered but tracked", "found", "ATE, m", "without, m"),
    *("ratio", "worst unflagged, m", "without, m", "holds"),
)


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_line("What becomes of a camera that was covered, dropped frames or was elsewhere, as Markdown.")
    parser.add_argument("--seqs", nargs="+", default=["demo"], help="sequences with ground truth [demo]")
    parser.add_argument("--gaps", nargs="+", type=int, default=[30, 60, 150], help="frames missing [30 60 150]")
    parser.add_argument("--before", type=int, default=90, help="frames before the interruption [90]")
    parser.add_argument("--after", type=int, default=60, help="frames after it [60]")
    parser.add_argument("--masks", action="store_true", help="leave out the sequence's masks [nobody]")
    return parser


def main() -> None:
    """Print the table."""
    parser = arguments()
    options = parser.parse_args()
    lines = [*heading(), "", row(COLUMNS), row(["---", "---", *(len(COLUMNS) - 2) * ["---:"]])]
    config = load_config(overrides=[f"segmentation.source={'masks' if options.masks else 'none'}"])
    try:
        for name in options.seqs:
            place = located(name, options.data_root)
            masks = Path(place) / "masks" if options.masks else None
            sequence = load_sequence(place, data_root=options.data_root)
            lines += table(sequence, options.gaps, options.before, options.after, config, masks)
    except V3DError as error:
        parser.error(str(error))
    publish(lines, options, parser)


if __name__ == "__main__":
    main()
