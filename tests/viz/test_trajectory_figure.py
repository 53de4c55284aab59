"""Figure of a trajectory: colours, plane, alignment, gaps, few poses, errors."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.figure_pixels import count_pixels, read_picture
from helpers.trajectories import arc, shaken

from v3d_torch.errors import OutputError
from v3d_torch.types import Trajectory
from v3d_torch.viz.trajectory_figure import draw_trajectory, save_trajectory_figure, within

BLACK, BLUE = "black", "tab:blue"


def static_camera() -> Trajectory:
    return Trajectory(torch.arange(60, dtype=torch.float64), torch.eye(4, dtype=torch.float64).repeat(60, 1, 1))


def test_ground_truth_black_estimate_blue_difference_red(tmp_path: Path) -> None:
    save_trajectory_figure(arc(), shaken(arc()), tmp_path / "with.png", title="arc")
    save_trajectory_figure(None, shaken(arc()), tmp_path / "without.png", title="arc")
    with_truth, without = read_picture(tmp_path / "with.png"), read_picture(tmp_path / "without.png")
    reddish = [int(((i[..., 0] > 0.75) & (i[..., 1] < 0.5) & (i[..., 2] < 0.5)).sum()) for i in (with_truth, without)]
    assert count_pixels(with_truth, BLUE) > 1000 and count_pixels(without, BLUE) > 1000
    assert reddish[0] > 300 and reddish[1] == 0
    assert count_pixels(with_truth, BLACK) > count_pixels(without, BLACK) + 1000


@pytest.mark.parametrize(
    ("scale", "labels"),
    [((1.0, 0.1, 0.5), "xz"), ((0.1, 1.0, 0.5), "yz"), ((1.0, 1.0, 0.1), "xy"), ((0.0, 0.0, 0.0), "xy")],
)
def test_plane_has_the_two_axes_of_largest_extent(
    tmp_path: Path, scale: tuple[float, float, float], labels: str
) -> None:
    save_trajectory_figure(arc(scale), shaken(arc(scale), 1e-4), tmp_path / "figure.svg")
    assert "".join(re.findall(r"<!-- ([xyz]) \[m\] -->", (tmp_path / "figure.svg").read_text())) == labels


def test_estimate_is_drawn_aligned(tmp_path: Path) -> None:
    """An estimate that differs by its world frame only covers the ground truth, and its error in the legend is zero."""
    T_ew = torch.tensor([[0, -1, 0, 9], [1, 0, 0, 9], [0, 0, 1, 9], [0, 0, 0, 1]], dtype=torch.float64)
    save_trajectory_figure(arc(), Trajectory(arc().stamps, T_ew @ arc().T_wc), tmp_path / "figure.svg")
    drawing = (tmp_path / "figure.svg").read_text()
    assert "<!-- difference (ATE RMSE 0.0000 m) -->" in drawing
    truth, estimate = (
        re.findall(rf'<path d="([^"]+)"[^>]*stroke: {c}[^>]*', drawing)[0] for c in ("#000000; st", "#1f77b4")
    )
    assert truth.count("L") > 30
    np.testing.assert_allclose(*([float(n) for n in re.findall(r"[\d.]+", d)] for d in (truth, estimate)), atol=1e-3)


def test_differences_are_one_path(tmp_path: Path) -> None:
    """One element per pose makes the report of a long run slow to open."""
    save_trajectory_figure(arc(), shaken(arc()), tmp_path / "figure.svg")
    differences, _legend = re.findall(r'<path d="([^"]+)"[^>]*stroke: #d62728', (tmp_path / "figure.svg").read_text())
    assert differences.count("M") == len(arc())


@pytest.mark.parametrize("poses", [0, 1, 2, 60])
@pytest.mark.parametrize("groundtruth", ["none", "still", "elsewhere"])
def test_few_poses_and_static_camera_are_drawn(tmp_path: Path, poses: int, groundtruth: str) -> None:
    truth = {
        "none": None,
        "still": static_camera(),
        "elsewhere": Trajectory(static_camera().stamps + 1e4, static_camera().T_wc),
    }[groundtruth]
    estimate = shaken(static_camera(), 1e-3)
    save_trajectory_figure(truth, Trajectory(estimate.stamps[:poses], estimate.T_wc[:poses]), tmp_path / "figure.png")
    image = read_picture(tmp_path / "figure.png")
    assert min(image.shape[:2]) > 500
    assert (count_pixels(image, BLUE) > 300) == (poses > 2)


@pytest.mark.parametrize("poses", [1, 2, 3])
def test_error_of_fewer_than_three_poses_is_not_drawn(poses: int) -> None:
    estimate = shaken(arc(), 1e-3)
    figure = draw_trajectory(arc(), Trajectory(estimate.stamps[:poses], estimate.T_wc[:poses]))
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert any("ATE RMSE" in label for label in labels) == (poses == 3)


def test_curve_has_gap_where_poses_are_missing(tmp_path: Path) -> None:
    present = torch.cat([torch.arange(0, 20), torch.arange(40, 60)])
    estimate = Trajectory(arc().stamps[present], arc().T_wc[present])
    save_trajectory_figure(None, estimate, tmp_path / "figure.svg")
    line = re.findall(r'<path d="([^"]+)"[^>]*stroke: #1f77b4', (tmp_path / "figure.svg").read_text())[0]
    assert line.count("M") == 2


@pytest.mark.parametrize("truth", [None, arc()])
def test_guessed_poses_are_dotted(truth: Trajectory | None, tmp_path: Path) -> None:
    """The dotted curve joins the measured ones, whose gap has the length of the guessed part."""
    statuses = 20 * ["tracked"] + 15 * ["lost"] + 5 * ["disconnected"] + 20 * ["odometry"]
    save_trajectory_figure(truth, arc(), tmp_path / "figure.svg", statuses=statuses)
    drawing = (tmp_path / "figure.svg").read_text()
    assert "<!-- estimate, disconnected or lost -->" in drawing
    measured = re.findall(r'<path d="([^"]+)"[^>]*stroke: #1f77b4', drawing)[0]
    dotted = re.findall(r'<path d="([^"]+)"[^>]*stroke-dasharray[^>]*stroke: #ff7f0e', drawing)[0]
    ends = [part.split("L")[index].split() for part, index in zip(measured.split("M")[1:], (-1, 0), strict=True)]
    assert [part.split() for part in (dotted[1:].split("L")[0], dotted.split("L")[-1])] == ends
    save_trajectory_figure(truth, arc(), tmp_path / "figure.svg", statuses=60 * ["tracked"])
    assert "disconnected" not in (tmp_path / "figure.svg").read_text()


def test_legend_of_a_run_without_measured_poses_lists_no_estimate() -> None:
    figure = draw_trajectory(None, arc(), statuses=60 * ["lost"])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["estimate, lost", "start"]


def test_same_trajectory_gives_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save_trajectory_figure(arc(), shaken(arc()), tmp_path / f"{name}.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_unwritable_figure_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    (tmp_path / "figure.png").mkdir()
    with pytest.raises(OutputError, match=r"figure\.png"):
        save_trajectory_figure(None, arc(), tmp_path / "figure.png")
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]


def test_ground_truth_is_drawn_during_the_estimate_only() -> None:
    """Ground truth is often recorded for longer than the images."""
    truth = arc()
    part = Trajectory(truth.stamps[20:40], truth.T_wc[20:40])
    inside = within(truth, part)
    assert torch.equal(inside.stamps, part.stamps) and torch.equal(inside.T_wc, part.T_wc)
    curve = draw_trajectory(truth, part).axes[0].lines[0]
    assert curve.get_label() == "ground truth" and len(np.asarray(curve.get_xdata())) == 20
