"""Figures: the colours that must be there are, whatever the camera did."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from v3d_torch.errors import OutputError
from v3d_torch.types import Trajectory
from v3d_torch.viz.figures import VERDICT_COLOURS, mask_strip, trajectory_figure

BLACK, BLUE, RED = "black", "tab:blue", "tab:red"


def arc(scale: tuple[float, float, float] = (1.0, 0.1, 0.5)) -> Trajectory:
    s = torch.linspace(0, 4, 60, dtype=torch.float64)
    T_wc = torch.eye(4, dtype=torch.float64).repeat(60, 1, 1)
    T_wc[:, :3, 3] = torch.stack([s.cos(), s, (2 * s).sin()], dim=1) * torch.tensor(scale, dtype=torch.float64)
    return Trajectory(s, T_wc)


def shaken(trajectory: Trajectory, sigma: float = 0.05) -> Trajectory:
    T_wc = trajectory.T_wc.clone()
    noise = torch.randn(len(trajectory), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    T_wc[:, :3, 3] += sigma * noise
    return Trajectory(trajectory.stamps, T_wc)


def still() -> Trajectory:
    return Trajectory(torch.arange(60, dtype=torch.float64), torch.eye(4, dtype=torch.float64).repeat(60, 1, 1))


def image_of(path: Path) -> NDArray[np.float64]:
    return cv2.imread(str(path), cv2.IMREAD_COLOR_RGB) / 255.0


def count(image: NDArray[np.float64], colour: str) -> int:
    return int((np.abs(image - to_rgb(colour)).max(axis=2) < 0.02).sum())


def test_ground_truth_black_estimate_blue_difference_red(tmp_path: Path) -> None:
    trajectory_figure(arc(), shaken(arc()), tmp_path / "with.png", title="arc")
    trajectory_figure(None, shaken(arc()), tmp_path / "without.png", title="arc")
    with_truth, without = image_of(tmp_path / "with.png"), image_of(tmp_path / "without.png")
    reddish = [int(((i[..., 0] > 0.75) & (i[..., 1] < 0.5) & (i[..., 2] < 0.5)).sum()) for i in (with_truth, without)]
    assert count(with_truth, BLUE) > 1000 and count(without, BLUE) > 1000
    assert reddish[0] > 300 and reddish[1] == 0
    assert count(with_truth, BLACK) > count(without, BLACK) + 1000


@pytest.mark.parametrize(
    ("scale", "labels"),
    [((1.0, 0.1, 0.5), "xz"), ((0.1, 1.0, 0.5), "yz"), ((1.0, 1.0, 0.1), "xy"), ((0.0, 0.0, 0.0), "xy")],
)
def test_the_plane_is_the_one_of_most_motion(tmp_path: Path, scale: tuple[float, float, float], labels: str) -> None:
    trajectory_figure(arc(scale), shaken(arc(scale), 1e-4), tmp_path / "figure.svg")
    assert "".join(re.findall(r"<!-- ([xyz]) \[m\] -->", (tmp_path / "figure.svg").read_text())) == labels


def test_the_estimate_is_drawn_aligned(tmp_path: Path) -> None:
    """Perfect but for its world: it covers the ground truth, and the legend says that nothing is wrong."""
    T_ew = torch.tensor([[0, -1, 0, 9], [1, 0, 0, 9], [0, 0, 1, 9], [0, 0, 0, 1]], dtype=torch.float64)
    trajectory_figure(arc(), Trajectory(arc().stamps, T_ew @ arc().T_wc), tmp_path / "figure.svg")
    drawing = (tmp_path / "figure.svg").read_text()
    assert "<!-- difference (ATE RMSE 0.0000 m) -->" in drawing
    truth, estimate = (
        re.findall(rf'<path d="([^"]+)"[^>]*stroke: {c}[^>]*', drawing)[0] for c in ("#000000; st", "#1f77b4")
    )
    assert truth.count("L") > 30
    np.testing.assert_allclose(*([float(n) for n in re.findall(r"[\d.]+", d)] for d in (truth, estimate)), atol=1e-3)


@pytest.mark.parametrize("poses", [0, 1, 2, 60])
@pytest.mark.parametrize("groundtruth", ["none", "still", "elsewhere"])
def test_few_poses_and_a_camera_that_stands_still(tmp_path: Path, poses: int, groundtruth: str) -> None:
    truth = {"none": None, "still": still(), "elsewhere": Trajectory(still().stamps + 1e4, still().T_wc)}[groundtruth]
    estimate = shaken(still(), 1e-3)
    trajectory_figure(truth, Trajectory(estimate.stamps[:poses], estimate.T_wc[:poses]), tmp_path / "figure.png")
    image = image_of(tmp_path / "figure.png")
    assert min(image.shape[:2]) > 500
    assert (count(image, BLUE) > 300) == (poses > 2)


def test_a_stretch_without_poses_is_not_bridged(tmp_path: Path) -> None:
    kept = torch.cat([torch.arange(0, 20), torch.arange(40, 60)])
    estimate = Trajectory(arc().stamps[kept], arc().T_wc[kept])
    trajectory_figure(None, estimate, tmp_path / "figure.svg")
    line = re.findall(r'<path d="([^"]+)"[^>]*stroke: #1f77b4', (tmp_path / "figure.svg").read_text())[0]
    assert line.count("M") == 2


def frames(number: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    generator = torch.Generator().manual_seed(1)
    images = [torch.randint(0, 256, (3, 120, 160), dtype=torch.uint8, generator=generator) for _ in range(number)]
    masks = [torch.zeros(120, 160, dtype=torch.bool) for _ in range(number)]
    for mask in masks:
        mask[20:115, 30:130] = True
    return images, masks


@pytest.mark.parametrize("verdict", [*VERDICT_COLOURS, "some other word"])
def test_masks_are_tinted_by_verdict(tmp_path: Path, verdict: str) -> None:
    images, masks = frames(1)
    images = [torch.zeros_like(images[0])]
    mask_strip(images, [[(masks[0], "person 3", verdict)]], tmp_path / "masks.png")
    image = image_of(tmp_path / "masks.png")
    colour = VERDICT_COLOURS.get(verdict, VERDICT_COLOURS["unknown"])
    tint = np.array(to_rgb(colour)) * 0.45
    inside = (np.abs(image - tint).max(axis=2) < 0.02).mean()
    assert 0.3 < inside < 95 * 100 / (120 * 160)
    assert count(image, colour) > 500  # outline, name, legend
    others = set(VERDICT_COLOURS.values()) - {colour, VERDICT_COLOURS["unknown"]}  # soft edges of letters are gray, too
    assert all(count(image, other) == 0 for other in others)


def test_the_legend_names_the_verdicts_in_view(tmp_path: Path) -> None:
    images, masks = frames(2)
    overlays = [[(masks[0], "person 3", "dynamic")], [(masks[1], "chair 4", "static"), (~masks[1], "cup 5", "static")]]
    mask_strip(images, overlays, tmp_path / "masks.svg")
    words = re.findall(r"<!-- (.+?) -->", (tmp_path / "masks.svg").read_text())
    assert words == ["person 3", "chair 4", "cup 5", "static", "dynamic"]


@pytest.mark.parametrize(("number", "columns", "rows"), [(1, 1, 1), (2, 2, 1), (4, 3, 2), (6, 3, 2), (9, 3, 2)])
def test_six_frames_at_most_in_rows_of_three(tmp_path: Path, number: int, columns: int, rows: int) -> None:
    images, masks = frames(number)
    mask_strip(images, [[(mask, "person 1", "static")] for mask in masks], tmp_path / "masks.svg")
    drawing = (tmp_path / "masks.svg").read_text()
    assert drawing.count("<!-- person 1 -->") == min(number, 6)
    width, height = map(float, re.findall(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', drawing)[0])
    assert width / height == pytest.approx(4 * columns / (3 * rows + 0.4), rel=0.01)


def test_objects_that_are_not_in_the_picture_and_none_at_all(tmp_path: Path) -> None:
    images, masks = frames(2)
    mask_strip(images, [[(torch.zeros_like(masks[0]), "person 1", "predicted")], []], tmp_path / "masks.svg")
    assert "person 1" not in (tmp_path / "masks.svg").read_text()
    with pytest.raises(ValueError, match="at least one image"):
        mask_strip([], [], tmp_path / "masks.png")
    with pytest.raises(ValueError, match="zip"):
        mask_strip(images, [[]], tmp_path / "masks.png")


def test_same_input_same_bytes(tmp_path: Path) -> None:
    images, masks = frames(1)
    for name in ("a", "b"):
        trajectory_figure(arc(), shaken(arc()), tmp_path / f"{name}.png")
        mask_strip(images, [[(masks[0], "person 3", "dynamic")]], tmp_path / f"{name}_masks.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a_masks.png").read_bytes() == (tmp_path / "b_masks.png").read_bytes()


def test_a_figure_that_cannot_be_written_is_said_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "figure.png").mkdir()
    with pytest.raises(OutputError, match=r"figure\.png"):
        trajectory_figure(None, arc(), tmp_path / "figure.png")
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]


def test_no_global_state_of_pyplot() -> None:
    probe = "import sys, v3d_torch.viz.figures; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout.strip() == "False"
