"""Text of camera files, read back."""

from __future__ import annotations

from pathlib import Path

import pytest

from v3d_torch.datasets.camera_text import camera_text
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.geometry.camera import PinholeCamera

PLAIN = PinholeCamera(520.5, 521.5, 319.5, 239.5)
CAMERAS = [
    PLAIN,
    PinholeCamera(
        *(520.5, 521.5, 319.5, 239.5, 640, 480, (1e-5, -0.2, 0.003, 1e-20, 0.0), 5000.0, 0.02),
        depth_delay=-0.01,
        inverse_depth_offset=1e-5,
    ),
    PinholeCamera(
        *(300.0, 300.0, 319.5, 239.5, 640, 480, (0.03, -0.01, 0.004, -0.002)), distortion_model="equidistant"
    ),
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_camera_is_read_back_exactly(camera: PinholeCamera, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(camera_text(camera, {"fx": "525 +- 1, given 520"}))
    assert load_camera(tmp_path / "camera.yaml") == camera


def test_comment_follows_its_field() -> None:
    assert "fx: 520.5  # 525 +- 1\nfy: 521.5\n" in camera_text(PLAIN, {"fx": "525 +- 1"})
