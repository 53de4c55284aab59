"""What the plausibility check finds in sequences that were made wrong on purpose, as Markdown.

``python benchmarks/plausibility.py --seqs demo fr1_rpy`` changes the camera file, the depth images or the colour images
of each sequence, runs its first frames, and counts the warnings: a right sequence must have none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import columns
import torch
from command import add_sequences_option, make_parser, publish_rows
from storage import Row
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.base import RGBDSequence
from v3d_torch.errors import V3DError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.pipeline import Pipeline
from v3d_torch.runs.diagnosis import check_lost_frames, diagnose
from v3d_torch.runs.request import RunRequest
from v3d_torch.segmentation import make_instance_source, wrap_upright
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, Segmenter, Trajectory

_SHIFT = (20, -10)
"""Shift of depth that is not registered along u and v, pixels."""

_LATE = 3
"""Frames between colour and depth that are not simultaneous: 0.1 s at 30 Hz."""


def _scaled(camera: PinholeCamera, fx: float, fy: float) -> PinholeCamera:
    return replace(camera, fx=fx * camera.fx, fy=fy * camera.fy)


def _with_depth_scale(camera: PinholeCamera, factor: float) -> PinholeCamera:
    return replace(camera, depth_scale=factor * (camera.depth_scale or 1.0))


def _doubled(camera: PinholeCamera) -> PinholeCamera:
    return replace(_scaled(camera, 2.0, 2.0), cx=2 * camera.cx, cy=2 * camera.cy)


@dataclass(frozen=True)
class Change:
    """Something that is wrong in a sequence.

    Attributes:
        words: Words of the warning that names it; none for a right sequence.
        camera: Changes the camera.
        late: Frames by which depth is late.
        shift: Shift of the depth images along u and v, pixels.
        exchanged: True if red and blue are exchanged.
    """

    words: str = ""
    camera: Callable[[PinholeCamera], PinholeCamera] = lambda camera: camera
    late: int = 0
    shift: tuple[int, int] = (0, 0)
    exchanged: bool = False


CHANGES = {
    "nothing": Change(),
    "depth_scale divided by 5": Change("depth_scale", lambda camera: _with_depth_scale(camera, 0.2)),
    "depth_scale times 5": Change("depth_scale", lambda camera: _with_depth_scale(camera, 5.0)),
    "camera of images twice as large": Change("focal lengths", _doubled),
    "fx halved": Change("focal lengths", lambda camera: _scaled(camera, 0.5, 1.0)),
    "fx and fy halved": Change("focal lengths", lambda camera: _scaled(camera, 0.5, 0.5)),
    f"depth shifted by {_SHIFT} pixels": Change("shifted", shift=_SHIFT),
    f"depth {_LATE} frames late": Change("seem to be taken", late=_LATE),
    "red and blue exchanged": Change("red and blue", exchanged=True),
}
"""Changes by their names."""


class ChangedSequence:
    """First frames of a sequence, with something wrong.

    Args:
        source: Sequence as `load_sequence` takes it.
        change: What is wrong.
        frames: Maximum number of frames.
    """

    def __init__(self, source: str, change: Change, frames: int) -> None:
        self.camera = change.camera(load_sequence(source).camera)
        self._sequence = load_sequence(source, camera=self.camera)
        self._change = change
        self._count = min(frames, len(self._sequence) - _LATE)

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return self._sequence.name

    @property
    def groundtruth(self) -> Trajectory | None:
        """No measured poses."""
        return None

    @property
    def stamps(self) -> Tensor:
        """Timestamps, see `RGBDSequence`."""
        return self._sequence.stamps[: self._count]

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> RGBDFrame:
        frame, change = self._sequence[index], self._change
        depth = self._sequence[index + change.late].depth if change.late else frame.depth
        u, v = change.shift
        if change.shift != (0, 0):
            moved = torch.zeros_like(depth)
            height, width = depth.shape[1:]
            to, origin = _overlap(height, v), _overlap(width, u)
            moved[:, to[0], origin[0]] = depth[:, to[1], origin[1]]
            depth = moved
        image = frame.image.flip(0) if change.exchanged else frame.image
        return replace(frame, image=image, depth=depth)

    def __iter__(self) -> Iterator[RGBDFrame]:
        return map(self.__getitem__, range(len(self)))


def _overlap(size: int, shift: int) -> tuple[slice, slice]:
    """Pixels of a shifted image along an axis, and where they come from."""
    return slice(max(shift, 0), size + min(shift, 0)), slice(max(-shift, 0), size - max(shift, 0))


class RememberedInstances:
    """Instances of each image, found once for all changes that leave the colour images as they are.

    Args:
        segment: Segmenter of single images.
    """

    def __init__(self, segment: Segmenter) -> None:
        self._segment = segment
        self._found: dict[tuple[float, int, int], Instances] = {}

    def __call__(self, frame: RGBDFrame) -> Instances:
        """Return the instances of a frame; turned images are told apart by their corner and shape."""
        key = frame.stamp, frame.image.shape[1], int(frame.image[:, ::40, ::40].long().mul(_position(frame)).sum())
        if key not in self._found:
            self._found[key] = self._segment(frame)
        return self._found[key]


def _position(frame: RGBDFrame) -> Tensor:
    """Different numbers for some pixels of an image."""
    few = frame.image[:, ::40, ::40]
    return torch.arange(few.numel()).reshape(few.shape)


def find_warnings(sequence: RGBDSequence, segment: Segmenter, config: Config) -> list[str]:
    """Run a sequence and return what the command would say: warnings, and the cause of lost frames.

    Raises:
        V3DError: If the sequence is refused.
    """
    torch.manual_seed(config.seed)
    pipeline = Pipeline(sequence, V3DSLAM(sequence.camera, segment, config), evaluate_masks=False)
    record = pipeline()
    if record.failure is not None:
        raise V3DError(record.failure)
    pipeline.flush()
    diagnosis = diagnose(pipeline, RunRequest(sequence.name, config), None)
    return [*record.warnings, *check_lost_frames(pipeline), *([] if diagnosis is None else [diagnosis])]


def measure(source: str, frames: int, config: Config) -> Iterator[Row]:
    """Yield a row per change."""
    network = make_instance_source(config.segmentation)
    remembered = RememberedInstances(network)
    for name, change in CHANGES.items():
        # Colours are compared by the network, so its instances must be found again.
        instances = network if change.exchanged or not change.words else remembered
        sequence = ChangedSequence(source, change, frames)
        try:
            warnings = find_warnings(sequence, wrap_upright(instances, config.segmentation), config)
        except V3DError as error:
            warnings = [f"refused: {error}"]
        yield {
            "sequence": Path(source).name,
            "frames": f"{len(sequence)}",
            "change": name,
            "result": _result(change, warnings),
            "warnings": "; ".join(warnings) or "none",
        }


def _result(change: Change, warnings: list[str]) -> str:
    if not change.words:
        return "false alarm" if warnings else "right"
    if any(change.words in warning for warning in warnings):
        return "found"
    return "another cause named" if warnings else "missed"


def main() -> None:
    """Run all changes and print the table."""
    parser = make_parser("What the plausibility check finds in sequences that were made wrong, as Markdown.")
    add_sequences_option(parser, "a right camera")
    parser.add_argument("--frames", type=int, default=120, help="frames of each sequence [120]")
    options = parser.parse_args()
    config = load_config()
    publish_rows(
        parser, options, "plausibility", columns.PLAUSIBILITY, lambda source: measure(source, options.frames, config)
    )


if __name__ == "__main__":
    main()
