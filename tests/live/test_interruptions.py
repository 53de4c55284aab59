"""Live runs in which camera or transport fail for some time: the camera is tracked again at a known place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers.long_wall import CAMERA, Slide
from helpers.paced_frames import paced

from v3d_torch.config import Config
from v3d_torch.live import LiveResult, LiveSLAM
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus

SLIDE = Slide(0, 408)
EVENT = 20
"""Index of the frame at which the interruption begins, after 2 s."""

Frames = list[RGBDFrame]


def stalled(frames: Frames) -> Frames:
    """No frame for a second, during which the camera moves on."""
    return frames[:EVENT] + frames[EVENT + 10 :]


def unplugged(frames: Frames) -> Frames:
    """No frame for a minute, during which the camera is carried back to its first place."""
    return frames[:EVENT] + [replace(frame, stamp=frame.stamp + 60 + EVENT / 10) for frame in frames]


def darker(frames: Frames) -> Frames:
    """The exposure drops to two fifths from one frame to the next."""
    return frames[:EVENT] + [_expose(frame, 0.4) for frame in frames[EVENT:]]


def brighter(frames: Frames) -> Frames:
    """The exposure rises by three fifths, so that a third of the pixels saturates."""
    return frames[:EVENT] + [_expose(frame, 1.6) for frame in frames[EVENT:]]


def covered(frames: Frames) -> Frames:
    """A hand covers the lens for half a second."""
    black = [replace(frame, image=frame.image * 0, depth=frame.depth * 0) for frame in frames[EVENT : EVENT + 5]]
    return frames[:EVENT] + black + frames[EVENT + 5 :]


def doubled(frames: Frames) -> Frames:
    """Every frame comes twice."""
    return [frame for frame in frames for _ in range(2)]


def reordered(frames: Frames) -> Frames:
    """Every second frame comes after its successor, too late."""
    return [frame for pair in zip(frames[1::2], frames[::2], strict=False) for frame in pair]


def _expose(frame: RGBDFrame, factor: float) -> RGBDFrame:
    return replace(frame, image=(frame.image * factor).clamp(max=255).to(torch.uint8))


def run(frames: Frames) -> tuple[list[LiveResult], LiveSLAM]:
    slam = V3DSLAM(CAMERA, NoSegmentation(), Config())
    live = LiveSLAM(paced(frames, slam), slam)
    return list(live), live


@pytest.mark.parametrize(
    ("interrupt", "resumed"),
    [
        (stalled, EVENT + 10),
        (unplugged, EVENT),
        (darker, EVENT),
        (brighter, EVENT),
        (covered, EVENT + 5),
        (doubled, 0),
        (reordered, 0),
    ],
)
def test_camera_is_tracked_within_a_second_of_a_known_place(
    interrupt: Callable[[Frames], Frames], resumed: int
) -> None:
    """The camera sees a known place from the given position in the accepted frames on; a second has ten frames."""
    frames = interrupt([SLIDE[index] for index in range(len(SLIDE))])
    accepted = [frame for k, frame in enumerate(frames) if all(frame.stamp > other.stamp for other in frames[:k])]
    results, live = run(frames)
    assert [result.stamp for result in results] == [frame.stamp for frame in accepted]
    assert live.rejected == len(frames) - len(accepted)
    later = [result for result in results if result.stamp >= accepted[0].stamp + resumed / 10 + 1]
    assert len(later) >= 10
    for result in later:
        assert result.status is TrackingStatus.TRACKED
        assert (result.T_wc - SLIDE.T_wc[result.frame.index] @ SLIDE.T_wc[accepted[0].index].inverse())[
            :3, 3
        ].norm() < 0.02


def test_covariance_grows_while_the_camera_is_covered_and_shrinks_afterwards() -> None:
    results, _ = run(covered([SLIDE[index] for index in range(len(SLIDE))]))
    sigmas = [float(result.covariance[:3, :3].trace().sqrt()) for result in results]
    hidden = sigmas[EVENT : EVENT + 5]
    assert all(result.status is TrackingStatus.LOST for result in results[EVENT : EVENT + 5])
    assert sigmas[EVENT - 1] < hidden[0] and hidden == sorted(hidden) and hidden[-1] > 10 * sigmas[EVENT - 1]
    assert max(sigmas[EVENT + 10 :]) < hidden[0]
