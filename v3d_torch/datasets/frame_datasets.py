"""Frames, pairs of frames and clips of a sequence as data sets of torch, for training.

Samples are dictionaries of tensors, which `torch.utils.data.DataLoader` stacks to batches without a collate function of
your own. All samples of a data set have the same keys. Names follow torchvision (``frames_per_clip``,
``step_between_clips``, ``transform``) and kornia (``image0``, ``image1``).
"""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress

import torch
from torch import Tensor
from torch.utils.data import Dataset

from v3d_torch.datasets.base import HasMotionMasks, RGBDSequence
from v3d_torch.errors import InputError
from v3d_torch.geometry.se3 import invert
from v3d_torch.types import Trajectory

Sample = dict[str, Tensor]
"""A sample: tensors by their names."""

Transform = Callable[[Sample], Sample]
"""Function of a sample, such as an augmentation. It must be picklable for workers that are spawned."""

_MAX_POSE_GAP = 0.12
"""Maximum time between two true poses between which poses are interpolated, seconds: a hand-held camera that
accelerates by 1 m/s^2 is then at most 1.8 mm from the interpolated position. Motion capture that loses its markers has
gaps of seconds."""

_EXCLUDED = 255
"""Value of the motion mask of pixels that are unknown, see `HasMotionMasks`."""


class SequenceDataset(Dataset[Sample], ABC):
    """Base class of the data sets: a sample consists of some frames with the same distances in all samples.

    Args:
        sequence: Sequence with stored frames.
        offsets: Indices of the frames of a sample, relative to its first frame.
        step: Step between the first frames of two samples, frames.
        transform: Function that is applied to each sample; None for none.

    Attributes:
        sequence: The sequence.
        indices: Index in the sequence of the first frame of each sample.
        transform: The function that is applied to each sample.

    Raises:
        InputError: If the sequence has no stored frames, no frame of it has a true pose although it has ground truth,
            or it has no frames for a sample.
    """

    def __init__(
        self, sequence: RGBDSequence, offsets: Sequence[int], step: int = 1, transform: Transform | None = None
    ) -> None:
        if not isinstance(sequence, RGBDSequence):
            raise InputError(
                f"a data set needs a sequence with stored frames, got a {type(sequence).__name__}; give one, such as"
                ' load_sequence("demo")'
            )
        self.sequence = sequence
        self.transform = transform
        self._offsets = offsets
        truth = sequence.groundtruth
        self._T_wc = None if truth is None else truth.poses_at(sequence.stamps)
        has_pose = torch.ones(len(sequence), dtype=torch.bool) if truth is None else _is_known(truth, sequence.stamps)
        if len(sequence) and not has_pose.any():
            raise InputError(
                f"{sequence.name}: none of its {len(sequence)} frames has a true pose; check that stamps and ground"
                " truth belong to the same recording"
            )
        starts = torch.arange(0, max(0, len(sequence) - max(offsets)), step)
        are_known = torch.stack([has_pose[starts + offset] for offset in offsets]).all(dim=0)
        self.indices: list[int] = starts[are_known].tolist()
        if not self.indices:
            raise InputError(
                f"{sequence.name}: has no frames for a sample among its {len(sequence)} frames, of which"
                f" {int(has_pose.sum())} have a true pose; use fewer frames, or a smaller interval between them"
            )
        frames = sorted({first + offset for first in self.indices for offset in offsets})
        self._has_masks = isinstance(sequence, HasMotionMasks) and any(
            sequence.motion_mask(frame) is not None for frame in frames
        )

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.indices)

    def __getitem__(self, item: int) -> Sample:
        """Return a sample.

        Raises:
            IndexError: If there is no such sample.
            InputError: If an image is damaged, or if ``item`` is not an integer.
        """
        try:
            first = self.indices[operator.index(item)]
        except TypeError as error:
            raise InputError(
                f"{self.sequence.name}: the index of a sample must be an integer, got {item!r}; select several samples"
                " with torch.utils.data.Subset"
            ) from error
        sample = self._combine([self._read(first + offset) for offset in self._offsets])
        return sample if self.transform is None else self.transform(sample)

    @abstractmethod
    def _combine(self, frames: list[Sample]) -> Sample:
        """Make a sample of its frames."""

    def _read(self, index: int) -> Sample:
        """Read a frame of the sequence."""
        frame = self.sequence[index]
        sample = {
            "index": torch.tensor(index),
            "stamp": torch.tensor(frame.stamp, dtype=torch.float64),
            "image": frame.image,
            "depth": frame.depth,
            "K": self.sequence.camera.K,
        }
        if self._T_wc is not None:
            sample["T_wc"] = self._T_wc[index].clone()
        if self._has_masks and isinstance(self.sequence, HasMotionMasks):
            mask = self.sequence.motion_mask(index)
            sample["motion_mask"] = frame.image.new_full(frame.image.shape[1:], _EXCLUDED) if mask is None else mask
        return sample


class FrameDataset(SequenceDataset):
    """Frames of a sequence as samples of torch tensors.

    Frames without a true pose are left out, if the sequence has ground truth. A sample has the keys

    - ``index``: index of the frame in the sequence, int64, shape :math:`()`;
    - ``stamp``: time of the colour image, seconds, float64, shape :math:`()`;
    - ``image``: colour image with lens distortion, uint8 RGB, shape :math:`(3, H, W)`;
    - ``depth``: depth registered to the colour image, metres, float32, shape :math:`(1, H, W)`; 0 = no measurement;
    - ``K``: camera matrix, float64, shape :math:`(3, 3)`; the distortion is in ``sequence.camera``;
    - ``T_wc``: true camera-to-world pose at the stamp, float64, shape :math:`(4, 4)`, if the sequence has ground truth.
      It is interpolated between true poses that are at most 0.12 s apart;
    - ``motion_mask``: true motion mask, uint8, shape :math:`(H, W)`, see `HasMotionMasks`, if the sequence has masks;
      255 everywhere if that of the frame is missing.

    Args:
        sequence: Sequence, see `load_sequence`.
        transform: Function that is applied to each sample; None for none.

    Raises:
        InputError: If the sequence has no stored frames, or no frame with a true pose although it has ground truth.
    """

    def __init__(self, sequence: RGBDSequence, transform: Transform | None = None) -> None:
        super().__init__(sequence, (0,), transform=transform)

    def _combine(self, frames: list[Sample]) -> Sample:
        return frames[0]


class PairDataset(SequenceDataset):
    """Pairs of frames at a given interval, with their relative pose, as samples of torch tensors.

    A sample has the keys of `FrameDataset` for both frames, with the suffix 0 for the earlier and 1 for the later
    frame, such as ``image0`` and ``image1``, except for

    - ``K``: camera matrix of both frames, float64, shape :math:`(3, 3)`;
    - ``T_10``: true pose of camera 0 in camera 1, ``p_1 = T_10 @ p_0``, float64, shape :math:`(4, 4)`, if the sequence
      has ground truth, in place of ``T_wc``.

    Args:
        sequence: Sequence, see `load_sequence`.
        interval: Interval between the two frames, frames. Pairs overlap: each frame begins a pair.
        transform: Function that is applied to each sample; None for none.

    Raises:
        InputError: If the interval is not a positive integer, the sequence has no stored frames, or no pair with true
            poses although it has ground truth.
    """

    def __init__(self, sequence: RGBDSequence, interval: int = 1, transform: Transform | None = None) -> None:
        _check_positive("interval", interval)
        super().__init__(sequence, (0, interval), transform=transform)

    def _combine(self, frames: list[Sample]) -> Sample:
        sample = {"K": frames[0]["K"]}
        if self._T_wc is not None:
            sample["T_10"] = invert(frames[1]["T_wc"]) @ frames[0]["T_wc"]
        for number, frame in enumerate(frames):
            sample |= {f"{key}{number}": value for key, value in frame.items() if key not in ("K", "T_wc")}
        return sample


class ClipDataset(SequenceDataset):
    """Clips of consecutive frames as samples of torch tensors.

    A sample has the keys of `FrameDataset` with a leading dimension of the frames, such as ``image`` of shape
    :math:`(T, 3, H, W)` and ``T_wc`` of shape :math:`(T, 4, 4)`, except for

    - ``K``: camera matrix of all frames, float64, shape :math:`(3, 3)`.

    Args:
        sequence: Sequence, see `load_sequence`.
        frames_per_clip: Number of frames of a clip.
        step_between_clips: Step between the first frames of two clips, frames.
        transform: Function that is applied to each sample; None for none.

    Raises:
        InputError: If a number is not a positive integer, the sequence has no stored frames, or no clip with true poses
            although it has ground truth.
    """

    def __init__(
        self,
        sequence: RGBDSequence,
        frames_per_clip: int,
        step_between_clips: int = 1,
        transform: Transform | None = None,
    ) -> None:
        _check_positive("frames_per_clip", frames_per_clip)
        _check_positive("step_between_clips", step_between_clips)
        super().__init__(sequence, range(frames_per_clip), step_between_clips, transform)

    def _combine(self, frames: list[Sample]) -> Sample:
        stacked = {key: torch.stack([frame[key] for frame in frames]) for key in frames[0]}
        return {**stacked, "K": frames[0]["K"]}


def _check_positive(name: str, value: int) -> None:
    """Raise an error unless a value is a positive integer, of Python, NumPy or torch."""
    with suppress(TypeError):
        if operator.index(value) >= 1:
            return
    raise InputError(f"{name} is {value!r}; give a positive number of frames, as an integer")


def _is_known(truth: Trajectory, stamps: Tensor) -> Tensor:
    """Check at which times a pose is known: at a true pose, or between two that are close in time; bool, (K,)."""
    after = torch.searchsorted(truth.stamps, stamps)
    before, after = (after - 1).clamp(min=0), after.clamp(max=len(truth) - 1)
    is_between = (truth.stamps[before] <= stamps) & (stamps <= truth.stamps[after])
    is_exact = truth.stamps[after] == stamps
    return is_exact | (is_between & (truth.stamps[after] - truth.stamps[before] <= _MAX_POSE_GAP))
