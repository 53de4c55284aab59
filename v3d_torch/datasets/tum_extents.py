"""Extents of TUM sequences, with those of the paper's evaluation, to recognise parts and other recordings."""

from __future__ import annotations

from typing import NamedTuple

from v3d_torch.datasets.base import RGBDSequence, RGBDStream
from v3d_torch.datasets.realtime_playback import stored_source
from v3d_torch.datasets.sequence_names import find_paper_sequence, short_name
from v3d_torch.types import Trajectory

_MAX_MISSING_FRACTION = 0.01
"""Maximum fraction of missing frames of a whole sequence: rules of association differ in some frames."""

_MAX_STAMP_DIFFERENCE = 0.5
"""Maximum difference of the first and of the last timestamp of a whole sequence, seconds."""

_MAX_LENGTH_DIFFERENCE = 0.01
"""Maximum relative difference of the length of the true path: rounding, or another frame of reference, changes it by
less."""


class Span(NamedTuple):
    """Timestamps of frames or poses.

    Attributes:
        number: Number of timestamps.
        first: First timestamp, seconds.
        last: Last timestamp, seconds.
    """

    number: int
    first: float
    last: float


class Extent(NamedTuple):
    """A whole sequence.

    Attributes:
        frames: Associated colour and depth images.
        poses: Poses of the ground truth; None if they are not known.
        path_length: Length of the path through the true positions, metres; None if it is not known.
    """

    frames: Span
    poses: Span | None = None
    path_length: float | None = None


EXTENTS = {
    "fr1/rpy": Extent(
        Span(694, 1305031229.528748, 1305031253.598121), Span(2742, 1305031225.9334, 1305031253.6027), 2.6111
    ),
    "fr3/s/xyz": Extent(
        Span(1219, 1341845820.751833, 1341845863.315718), Span(4251, 1341845820.8614, 1341845863.3610), 6.1669
    ),
    "fr3/s/half": Extent(Span(1074, 1341845948.747856, 1341845986.042156)),
    "fr3/s/static": Extent(
        Span(680, 1341845688.561749, 1341845712.289935), Span(2364, 1341845688.7021, 1341845712.3321), 0.5650
    ),
    "fr3/s/rpy": Extent(Span(795, 1341846092.023798, 1341846119.565854)),
    "fr3/w/xyz": Extent(
        Span(827, 1341846313.592026, 1341846342.416195), Span(2884, 1341846313.6378, 1341846342.4702), 6.6181
    ),
    "fr3/w/half": Extent(
        Span(1021, 1341846434.710184, 1341846470.606133), Span(3582, 1341846434.8269, 1341846470.6367), 8.5360
    ),
    "fr3/w/static": Extent(
        Span(717, 1341846226.817920, 1341846251.749907), Span(2483, 1341846226.9190, 1341846251.7483), 0.6295
    ),
    "fr3/w/rpy": Extent(
        Span(866, 1341846647.802247, 1341846678.439991), Span(3062, 1341846647.8653, 1341846678.4751), 3.2772
    ),
}
"""Extents by short name, from the lists and ground truths of the TUM benchmark. The true poses of fr3/s/half and
fr3/s/rpy are not included."""


def describe_difference(source: RGBDStream) -> str | None:
    """Describe how a sequence differs from the sequence of the TUM benchmark that its name contains.

    Args:
        source: Sequence or its playback, such as ``fr3_walking_xyz_first300``, which is compared with ``fr3/w/xyz``.

    Returns:
        Text such as "part: 60 of 827 frames"; None if the sequences agree, or if the extent is not known.
    """
    sequence = stored_source(source)
    extent = _find_extent(sequence.name)
    if extent is None or not isinstance(sequence, RGBDSequence) or len(sequence) == 0:
        return None
    stamps = sequence.stamps
    frames = Span(len(sequence), float(stamps[0]), float(stamps[-1]))
    if difference := _compare(frames, extent.frames, "frames"):
        return difference
    return None if sequence.groundtruth is None else _compare_truth(sequence.groundtruth, extent)


def describe_estimate_difference(name: str, estimate: Trajectory, groundtruth: Trajectory) -> str | None:
    """Describe how the sequence of an estimate differs from a sequence of the TUM benchmark.

    Args:
        name: Name of the sequence of the benchmark.
        estimate: Estimated poses, which can include colour images without depth.
        groundtruth: True poses.

    Returns:
        Text as that of `describe_difference`; None if the sequences agree, or if the extent is not known.
    """
    extent = _find_extent(name)
    if extent is None or len(estimate) == 0:
        return None
    number = min(len(estimate), extent.frames.number)
    poses = Span(number, float(estimate.stamps[0]), float(estimate.stamps[-1]))
    return _compare(poses, extent.frames, "frames") or _compare_truth(groundtruth, extent)


def _find_extent(name: str) -> Extent | None:
    """Find the extent of a sequence by the rule of the tables with the paper's results."""
    return EXTENTS.get(find_paper_sequence(name) or short_name(name))


def _compare_truth(truth: Trajectory, extent: Extent) -> str | None:
    """Describe how true poses differ from those of the benchmark; None if they do not, or if those are not known."""
    if extent.poses is None or extent.path_length is None:
        return None
    poses = Span(len(truth), float(truth.stamps[0]), float(truth.stamps[-1]))
    length = _path_length(truth)
    if _compare(poses, extent.poses, "poses") or abs(length / extent.path_length - 1) > _MAX_LENGTH_DIFFERENCE:
        return (
            f"other ground truth: {poses.number} poses over {length:.2f} m, not {extent.poses.number} over"
            f" {extent.path_length:.2f} m"
        )
    return None


def _compare(span: Span, whole: Span, unit: str) -> str | None:
    """Describe how a span differs from that of the whole sequence; None if it does not."""
    if span.last < whole.first or span.first > whole.last or span.number > (1 + _MAX_MISSING_FRACTION) * whole.number:
        return f"another recording: {span.number} {unit}, not {whole.number}"
    starts, ends = abs(span.first - whole.first), abs(span.last - whole.last)
    if span.number < (1 - _MAX_MISSING_FRACTION) * whole.number or max(starts, ends) > _MAX_STAMP_DIFFERENCE:
        return f"part: {span.number} of {whole.number} {unit}"
    return None


def _path_length(trajectory: Trajectory) -> float:
    return float(trajectory.T_wc[:, :3, 3].diff(dim=0).norm(dim=1).sum())
