"""Exposure of the colour images of views with a known fraction of white pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import pytest
import torch
from helpers.board_room import CAMERA, make_views
from helpers.first_frames import FirstFrames

from v3d_torch import V3DSLAM, load_sequence
from v3d_torch.calibration.exposure import check_exposure
from v3d_torch.config.loading import load_config
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.pipeline import Pipeline
from v3d_torch.types import RGBDFrame


def make_white_views(fractions: Sequence[float], *, from_earlier_run: bool = False) -> StaticViews:
    """Views of which a part of the columns is white, with the noise of JPEG."""
    views = StaticViews(CAMERA, 2)
    for view, fraction in zip(make_views(len(fractions))[0], fractions, strict=True):
        colour = view.colour.clamp(max=200)
        colour[:, :, : round(fraction * colour.shape[2])] = 251
        keyframe = replace(view.keyframe, frame=-1) if from_earlier_run else view.keyframe
        views.append(replace(view, keyframe=keyframe, colour=colour))
    return views


def test_overexposed_views_give_one_warning_with_their_times() -> None:
    views = make_white_views([0.0, 0.4, 0.5, 0.1, 0.6, 0.3])
    first, last = (list(views)[index].keyframe.stamp for index in (1, 4))
    (warning,) = check_exposure(views)
    assert warning.startswith(f"the images of 3 of 6 keyframes, from {first:.3f} to {last:.3f} s, are overexposed")
    assert "up to 60% of their pixels are white" in warning and warning.endswith("lower the exposure of the camera")


@pytest.mark.parametrize("fractions", [[], [0.3] * 6, [0.4, 0.9, 0.0, 0.0]])
def test_windows_and_single_white_views_give_no_warning(fractions: list[float]) -> None:
    assert check_exposure(make_white_views(fractions)) == []


def test_views_of_an_earlier_run_are_not_checked() -> None:
    assert check_exposure(make_white_views([0.9] * 6, from_earlier_run=True)) == []


def test_one_bright_channel_is_a_colour() -> None:
    views = StaticViews(CAMERA, 2)
    for view in make_views(4)[0]:
        colour = view.colour.clamp(max=200)
        colour[0] = 255
        views.append(replace(view, colour=colour))
    assert check_exposure(views) == []


class Overexposed(FirstFrames):
    """First frames of a sequence, too bright by a factor of 4."""

    def __iter__(self) -> Iterator[RGBDFrame]:
        for frame in super().__iter__():
            yield replace(frame, image=(4 * frame.image.float()).clamp(max=255).to(torch.uint8))


def test_overexposed_run_warns_at_its_end() -> None:
    demo = load_sequence("demo")
    config = load_config("baseline", ("mapping.max_keyframe_interval=2", "mapping.redundant_ratio=1"))
    for sequence, expected in ((FirstFrames(demo, 6), 0), (Overexposed(demo, 6), 1)):
        pipeline = Pipeline(sequence, V3DSLAM(demo.camera, config=config))
        assert pipeline().failure is None
        pipeline.flush()
        assert sum("overexposed" in warning for warning in pipeline.record.warnings) == expected
