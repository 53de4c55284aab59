"""Demo sequence: reproducible bytes, layout, ground truth, and storage in the cache."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers.demo_frames import copy_frames
from helpers.demo_views import world_points
from helpers.library_settings import torch_threads
from scipy.spatial.transform import Rotation

from v3d_torch.config import Config
from v3d_torch.datasets import demo
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.datasets.demo.scenes import SCENES
from v3d_torch.datasets.demo.scenes.walking import TRAJECTORY
from v3d_torch.datasets.demo.sequence import CAMERA, write_sequence
from v3d_torch.datasets.locate import check_name
from v3d_torch.datasets.sequence_names import BUILT_IN_SEQUENCES
from v3d_torch.errors import InputError, OutputError
from v3d_torch.runs.request import RunRequest


def read_files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    write_sequence(folder, range(0, 80, 40))
    return folder


def test_bytes_are_independent_of_threads_and_selected_frames(sequence: Path, tmp_path: Path) -> None:
    with torch_threads(2):
        write_sequence(tmp_path, range(40, 41))
        assert torch.get_num_threads() == 2
    first, second = read_files(sequence), read_files(tmp_path)
    image_names = [name for name in second if name.endswith((".png", ".jpg"))]
    assert len(image_names) == 4
    assert all(first[name] == second[name] for name in image_names)


def test_frames_copied_from_the_cache_are_those_that_are_rendered(sequence: Path, tmp_path: Path) -> None:
    copy_frames(tmp_path, range(0, 80, 40))
    assert read_files(tmp_path) == read_files(sequence)


def test_sequence_has_tum_layout_and_masks(sequence: Path) -> None:
    camera = load_camera(sequence / "camera.yaml")
    assert camera == CAMERA and camera.distortion == (0.0,) * 5 and camera.depth_scale == 5000 and camera.readout == 0
    lines = (sequence / "associations.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["1.000000", "2.333333"]
    for line in lines:
        _, colour, stamp, depth = line.split()
        assert cv2.imread(str(sequence / colour)).shape == (480, 640, 3)
        image = cv2.imread(str(sequence / depth), cv2.IMREAD_UNCHANGED)
        assert image.shape == (480, 640) and image.dtype == np.uint16
        mask = cv2.imread(str(sequence / "masks" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.shape == (480, 640) and set(np.unique(mask)) <= {0, 1, 2}


def test_convention_ground_truth_is_camera_to_world(sequence: Path) -> None:
    """Pixels of the horizontal counter back-project to its height only with T_wc of a camera that looks along +z."""
    poses = np.loadtxt(sequence / "groundtruth.txt")
    depth = cv2.imread(str(sequence / "depth" / "1.000000.png"), cv2.IMREAD_UNCHANGED) / 5000.0
    T_wc = np.eye(4)
    T_wc[:3, :3] = Rotation.from_quat(poses[0, 4:]).as_matrix()
    T_wc[:3, 3] = poses[0, 1:4]
    points = world_points(torch.from_numpy(depth), T_wc, CAMERA)[440:, 250:350][depth[440:, 250:350] > 0]
    assert np.median(points[:, 2]) == pytest.approx(0.90, abs=0.003)
    assert np.allclose(T_wc, TRAJECTORY.pose(0.0), atol=1e-8)


def test_names_are_those_of_the_scenes() -> None:
    assert tuple(SCENES) == BUILT_IN_SEQUENCES
    for name in BUILT_IN_SEQUENCES:
        check_name(name, None)
        assert RunRequest(name, Config()).absolute().seq == name
    with pytest.raises(InputError, match="did you mean demo:sitting"):
        check_name("demo:siting", None)


def test_sequences_have_instances_with_labels(sequence: Path) -> None:
    """The person who stands still is an instance, but does not move."""
    stamp = "2.333333"
    paths = (sequence / folder / f"{stamp}.png" for folder in ("instances", "masks"))
    instances, moving = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths)
    assert set(np.unique(instances)) == {0, 1, 2, 3} and set(np.unique(moving)) == {0, 1, 2}
    assert (instances[moving > 0] == moving[moving > 0]).all()
    assert (sequence / "instances" / "labels.yaml").read_text() == "1: person\n2: person\n3: person\n"


# --- cache


def fake_sequence(
    folder: Path, frames: range = range(2), progress: demo.Progress | None = None, name: str = "demo"
) -> None:
    folder.mkdir(parents=True)
    (folder / "rgb.txt").write_text(f"rendered {name}")
    if progress is not None:
        progress(2, 2)


def test_demo_is_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "write_sequence", fake_sequence)
    reports: list[tuple[int, int]] = []
    folder = demo.ensure_demo(tmp_path / "cache", lambda done, total: reports.append((done, total)))
    assert folder.parent == tmp_path / "cache" and (folder / "rgb.txt").read_text() == "rendered demo"
    assert demo.ensure_demo(tmp_path / "cache", lambda done, total: reports.append((done, total))) == folder
    assert reports == [(2, 2)]
    assert [p.name for p in (tmp_path / "cache").iterdir()] == [folder.name]
    other = demo.ensure_demo(tmp_path / "cache", name="demo:sitting")
    assert other.name.startswith("demo-sitting-") and (other / "rgb.txt").read_text() == "rendered demo:sitting"


def test_interrupted_rendering_leaves_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(
        folder: Path, frames: range = range(2), progress: demo.Progress | None = None, name: str = "demo"
    ) -> None:
        fake_sequence(folder)
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "write_sequence", interrupted)
    with pytest.raises(KeyboardInterrupt):
        demo.ensure_demo(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_unwritable_cache_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(OutputError, match=r"cache: cannot store demo \(File exists\); set V3D_CACHE to another folder"):
        demo.ensure_demo(tmp_path / "cache")
