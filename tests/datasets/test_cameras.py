"""Camera files and presets."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.tiny_images import CAMERA_YAML

from v3d_torch.datasets.cameras import PRESETS, choose_camera, load_camera
from v3d_torch.errors import InputError
from v3d_torch.geometry.camera import PinholeCamera


def test_presets_have_published_parameters() -> None:
    assert PRESETS == ("d435i", "tum_fr1", "tum_fr2", "tum_fr3")
    assert load_camera("tum_fr1") == PinholeCamera(
        517.3, 516.5, 318.6, 255.3, distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633), depth_scale=5000
    )
    assert load_camera("tum_fr2") == PinholeCamera(
        520.9, 521.0, 325.1, 249.7, distortion=(0.2312, -0.7849, -0.0033, -0.0001, 0.9172), depth_scale=5000
    )
    assert load_camera("tum_fr3") == PinholeCamera(535.4, 539.2, 320.1, 247.6, depth_scale=5000)
    assert load_camera("d435i").depth_scale == 1000


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "camera.yaml",
            "fx: 1\nfy: 2\ncx: 3\ncy: 4\nwidth: 5\nheight: 6\ndepth_scale: 7\ndistortion: [1, 2, 3, 4, 5]\n",
        ),
        ("CAMERA.YAML", "fx: 1\nfy: 2\ncx: 3\ncy: 4\nwidth: 5\nheight: 6\ndepth_scale: 7\n"),
        ("K.txt", "# fx fy cx cy depth_scale w h\n1 2 3 4 7 5 6\n"),
        ("K.txt", "\ufeff1 2 3 4\r\n7 5, 6\r\n"),
        ("K.txt", "1 0 3\n0 2 4\n0 0 1\n"),
    ],
)
def test_camera_file_is_read(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    camera = load_camera(tmp_path / name)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (1, 2, 3, 4)
    matrix = len(text.split()) == 9
    assert (camera.width, camera.height, camera.depth_scale) == ((640, 480, None) if matrix else (5, 6, 7))
    assert camera.distortion == ((1, 2, 3, 4, 5) if name == "camera.yaml" else (0, 0, 0, 0, 0))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.yaml", CAMERA_YAML.replace("fx: 30.0\n", ""), "fx is missing; add it to the camera"),
        ("c.yaml", CAMERA_YAML.replace("30.0", "wide"), "fx: .*got 'wide'"),
        ("c.yaml", CAMERA_YAML.replace("30.0", "-30"), "fx: .*greater than or equal to 1.*got -30"),
        ("c.yaml", CAMERA_YAML.replace("30.0", "true"), "fx: input should be a number, got True; correct the camera"),
        ("c.yaml", CAMERA_YAML + "distortion: [0, 0, no, 0, 0]\n", "distortion: input should be a number, got .*False"),
        ("c.yaml", CAMERA_YAML.replace("15.5", ".nan"), "cx: .*finite.*got nan"),
        ("c.yaml", CAMERA_YAML + "distortion: [1, 2]\n", "distortion has 2 numbers; write k1, k2, p1, p2, k3"),
        ("c.yaml", CAMERA_YAML + "focal: 3\n", "unknown key focal; remove it"),
        ("c.yaml", CAMERA_YAML + "1: 3\n", "c.yaml: "),
        ("c.yaml", "{fx", "not valid YAML"),
        ("c.yaml", "!!python/object/apply:os.getcwd []", "not valid YAML"),
        ("c.yaml", "30", "does not contain a camera"),
        ("K.txt", "1 2 3", "contains 3 numbers"),
        ("K.txt", "1 9 3 0 2 4 0 0 1", "3x3 camera matrix without skew"),
        ("K.txt", "1 2 3 4 5000 640.5 480", "width: .*got 640.5"),
        ("K.txt", "one two", "not a number"),
        ("K.txt", "\udcff", "not a UTF-8 text file"),
    ],
)
def test_invalid_camera_file_is_rejected(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_bytes(text.encode("utf-8", errors="surrogateescape"))
    with pytest.raises(InputError, match=message) as caught:
        load_camera(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_preset_suggests_the_most_similar() -> None:
    with pytest.raises(InputError, match="did you mean tum_fr3"):
        load_camera("tum-fr3")


def test_error_of_a_distortion_names_the_camera_file(tmp_path: Path) -> None:
    text = "{width: 640, height: 480, fx: 525, fy: 525, cx: 319.5, cy: 239.5, distortion: [-3, 0, 0, 0, 0]}"
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(InputError, match=r"camera\.yaml: the distortion "):
        choose_camera(None, tmp_path)
