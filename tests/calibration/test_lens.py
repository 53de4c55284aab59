"""Lens models that map rays to all pixels, and such that fold back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
from helpers.first_frames import FirstFrames

from v3d_torch import V3DSLAM, load_sequence
from v3d_torch.calibration.lens import check_lens
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.cameras import PRESETS, load_camera
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.pipeline import Pipeline
from v3d_torch.types import RGBDFrame

FOLDED = PinholeCamera(250, 250, 160, 120, 320, 240, (-0.9,))
"""The distance of a pixel from the centre, r (1 - 0.9 r^2) focal lengths, is at most 0.4057, 101.4 pixels."""


def test_pixels_without_a_ray_give_one_warning_with_their_fraction() -> None:
    (warning,) = check_lens(FOLDED)
    distances = [math.hypot(u - 160, v - 120) for u in range(320) for v in range(240)]
    outside = sum(distance > 102.4 for distance in distances) / len(distances)  # by more than a pixel
    assert warning.startswith(f"the plumb_bob lens model of the camera maps no ray to {outside:.1%} of the pixels")
    assert warning.endswith("correct the distortion of the camera, or crop the images")


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_give_no_warning(preset: str) -> None:
    assert check_lens(load_camera(preset)) == []


@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera(130, 131, 158.7, 120.2, 320, 240, (-0.01, 0.02, -0.01, 0.002), distortion_model="equidistant"),
        PinholeCamera(458.7, 457.3, 367.2, 248.4, 752, 480, (-0.2834, 0.0740, 0.0002, 0.00002)),
    ],
    ids=["fisheye of 140 degrees", "EuRoC"],
)
def test_wide_lenses_give_no_warning(camera: PinholeCamera) -> None:
    assert check_lens(camera) == []


class Distorted(FirstFrames):
    """First frames of a sequence, with a camera whose distortion is wrong."""

    def __iter__(self) -> Iterator[RGBDFrame]:
        for frame in super().__iter__():
            yield replace(frame, camera=None)


@pytest.mark.parametrize(("distortion", "expected"), [((), 0), ((-0.9,), 1)])
def test_run_with_a_lens_that_folds_back_warns_at_its_end(distortion: tuple[float, ...], expected: int) -> None:
    demo = load_sequence("demo")
    camera = replace(demo.camera, distortion=distortion)
    pipeline = Pipeline(Distorted(demo, 2), V3DSLAM(camera, config=load_config("baseline")))
    assert pipeline().failure is None
    pipeline.flush()
    assert sum("maps no ray" in warning for warning in pipeline.record.warnings) == expected
