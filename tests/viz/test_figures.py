"""Figures: the colours that must be there are, whatever the camera did."""

from __future__ import annotations

import base64
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from v3d_torch.errors import InputError, OutputError
from v3d_torch.evaluation import evaluate
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory
from v3d_torch.viz.clusters import Cluster, clusters_figure
from v3d_torch.viz.figures import MOTION_STATE_COLOURS, Overlay, draw_objects, mask_strip, trajectory_figure
from v3d_torch.viz.inline import inline_image, inline_svg
from v3d_torch.viz.objects_over_time import ObjectRow, draw_objects_over_time
from v3d_torch.viz.stage_times import draw_stage_bars, draw_stages_over_time
from v3d_torch.viz.timelines import draw_errors, draw_positions, draw_share, draw_statuses
from v3d_torch.viz.voting import VOTE_COLOUR, voting_figure

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


@pytest.mark.parametrize("motion_state", [*MOTION_STATE_COLOURS, "some other word"])
def test_masks_are_tinted_by_verdict(tmp_path: Path, verdict: str) -> None:
    images, masks = frames(1)
    images = [torch.zeros_like(images[0])]
    mask_strip(images, [[(masks[0], "person 3", verdict)]], tmp_path / "masks.png")
    image = image_of(tmp_path / "masks.png")
    colour = MOTION_STATE_COLOURS.get(verdict, MOTION_STATE_COLOURS["unknown"])
    tint = np.array(to_rgb(colour)) * 0.45
    inside = (np.abs(image - tint).max(axis=2) < 0.02).mean()
    assert 0.3 < inside < 95 * 100 / (120 * 160)
    assert count(image, colour) > 500  # outline, name, legend
    others = set(MOTION_STATE_COLOURS.values()) - {
        colour,
        MOTION_STATE_COLOURS["unknown"],
    }  # soft edges of letters are gray, too
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
    probe = "import sys, v3d_torch.viz.report_page; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout.strip() == "False"


# --- who voted for whom


def vote(path: Path, *ballots: tuple[int, int], first: str = "static", second: str = "dynamic") -> NDArray[np.float64]:
    """The figure of three objects: 1 at the left, 2 in the middle, 3 at the right, which nobody voted for."""
    masks = torch.zeros(3, 120, 160, dtype=torch.bool)
    objects: dict[int, Overlay] = {}
    centres = {}
    for i, verdict in enumerate((first, second, "static")):
        masks[i, 50:70, 20 + 50 * i : 40 + 50 * i] = True
        objects[i + 1] = (masks[i], "", verdict)
        centres[i + 1] = torch.tensor([30.0 + 50 * i, 60.0])
    del centres[3]
    voting_figure(torch.zeros(3, 120, 160, dtype=torch.uint8), objects, centres, ballots, path)
    return image_of(path)[:720]  # without the legend


def test_a_vote_is_a_red_line_between_centroids(tmp_path: Path) -> None:
    image = vote(tmp_path / "voted.png", (1, 2))
    _, columns = (np.abs(image - to_rgb(VOTE_COLOUR)).max(axis=2) < 0.02).nonzero()
    width = image.shape[1]
    assert len(columns) > 500
    assert columns.min() / width > 30 / 160 - 0.02 and columns.max() / width < 80 / 160 + 0.02
    assert count(vote(tmp_path / "none.png"), VOTE_COLOUR) == 0
    assert count(vote(tmp_path / "nowhere.png", (1, 3), (3, 2)), VOTE_COLOUR) == 0  # 3 has no centroid


def test_votes_that_came_to_nothing_are_thin_and_a_mutual_vote_is_one_line(tmp_path: Path) -> None:
    bold = vote(tmp_path / "bold.png", (1, 2))
    thin = vote(tmp_path / "thin.png", (1, 2), second="static")
    assert count(thin, VOTE_COLOUR) < 0.2 * count(bold, VOTE_COLOUR)
    assert thin[..., 0].max() > 0.4
    assert np.array_equal(vote(tmp_path / "mutual.png", (1, 2), (2, 1)), bold)
    masks = torch.zeros(120, 160, dtype=torch.bool)
    for verdict, there in (("dynamic", False), ("static", True)):
        objects: dict[int, Overlay] = {1: (masks, "", "static"), 2: (masks, "", verdict)}
        centres = {1: torch.tensor([30.0, 60.0]), 2: torch.tensor([80.0, 60.0])}
        voting_figure(torch.zeros(3, 120, 160, dtype=torch.uint8), objects, centres, [(1, 2)], tmp_path / "vote.svg")
        assert ("without effect" in (tmp_path / "vote.svg").read_text()) == there


# --- clouds before and after outlier rejection


def cluster(rejected: int, text: str = "person 3") -> Cluster:
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    return Cluster(text, points, torch.arange(200) >= rejected, points[rejected::4])


def test_what_outlier_rejection_takes_away_is_black(tmp_path: Path) -> None:
    clusters_figure([cluster(0)], tmp_path / "none.png")
    clusters_figure([cluster(150)], tmp_path / "most.png")
    none, most = image_of(tmp_path / "none.png"), image_of(tmp_path / "most.png")
    half = none.shape[1] // 2
    assert count(most[150:600, :half], BLACK) > count(none[150:600, :half], BLACK) + 100
    assert count(none[:, :half], BLUE) > 150 > count(most[:, :half], BLUE)
    clusters_figure([cluster(150), cluster(10, "chair 4")], tmp_path / "both.svg")
    words = re.findall(r"<!-- (.+?) -->", (tmp_path / "both.svg").read_text())
    assert {"before: 400 points, 160 rejected", "after: 61 voxels", "person 3", "chair 4", "rejected"} <= set(words)
    with pytest.raises(ValueError, match="at least one"):
        clusters_figure([], tmp_path / "empty.png")


# --- over time


def test_errors_over_time_are_the_distances_after_alignment() -> None:
    """Against the same computed with numpy: Kabsch's rotation, then a difference of positions."""
    truth = arc()
    truth.T_wc[1:, :3, :3] = se3_exp(torch.tensor([0, 0, 0, 1e-7, 0, 0], dtype=torch.float64))[:3, :3]  # no placeholder
    estimate = shaken(truth)
    evaluation = evaluate(truth, estimate)
    position, drift, turn = draw_errors(truth, estimate, evaluation, ["tracked"] * 60).axes
    g, e = (t.T_wc[:, :3, 3].numpy() for t in (truth, estimate))
    U, _, Vt = np.linalg.svd((g - g.mean(0)).T @ (e - e.mean(0)))
    aligned = (e - e.mean(0)) @ (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T + g.mean(0)
    np.testing.assert_allclose(position.lines[0].get_ydata(), np.linalg.norm(aligned - g, axis=1), atol=1e-9)
    np.testing.assert_allclose(position.lines[1].get_ydata(), evaluation.ate.rmse)
    # Hardly anything turns: the drift is the difference of the two motions. A second is nearest to 15 of these frames.
    motions = (e[15:-1] - e[:-16]) - (g[15:-1] - g[:-16])
    np.testing.assert_allclose(drift.lines[0].get_ydata(), np.linalg.norm(motions, axis=1), atol=1e-6)
    np.testing.assert_allclose(turn.lines[0].get_ydata(), 0, atol=1e-5)
    assert [one.lines[0].get_xdata()[0] for one in (position, drift, turn)] == [0, 0, 0]


def test_frames_that_were_not_tracked_are_shaded() -> None:
    truth, estimate = arc(), shaken(arc())
    statuses = ["tracked"] * 50 + ["lost"] * 10
    shaded = draw_errors(truth, estimate, evaluate(truth, estimate), statuses).axes[0].collections
    assert len(shaded) == 1 and len(shaded[0].get_paths()) == 10
    start = shaded[0].get_paths()[0].vertices[:, 0].min()
    assert start == pytest.approx(49.5 * 4 / 59, abs=1e-6)


def test_positions_are_drawn_in_the_world_of_the_ground_truth() -> None:
    T_ew = torch.tensor([[0, -1, 0, 9], [1, 0, 0, 9], [0, 0, 1, 9], [0, 0, 0, 1]], dtype=torch.float64)
    estimate = Trajectory(arc().stamps + 100, T_ew @ arc().T_wc)
    truth = Trajectory(arc().stamps + 100, arc().T_wc)
    for axes, i in zip(draw_positions(truth, estimate, evaluate(truth, estimate)).axes, range(3), strict=True):
        for line in axes.lines:
            np.testing.assert_allclose(line.get_ydata(), truth.T_wc[:, i, 3], atol=1e-9)
            np.testing.assert_allclose(line.get_xdata(), arc().stamps)
    alone = draw_positions(None, estimate, None).axes
    assert [len(axes.lines) for axes in alone] == [1, 1, 1]
    np.testing.assert_allclose(alone[0].lines[0].get_ydata(), estimate.T_wc[:, 0, 3])


def test_statuses_and_keyframes_are_counted_and_placed() -> None:
    stamps = torch.arange(10, dtype=torch.float64) + 5
    statuses = ["lost"] + ["tracked"] * 8 + ["disconnected"]
    figure = draw_statuses(stamps, statuses, stamps[[1, 7]])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["8 tracked", "1 disconnected", "1 lost", "2 keyframes"]
    axes = figure.axes[0]
    assert np.ravel(axes.collections[0].get_array()).tolist() == [3.0] + [0.0] * 8 + [2.0]
    assert axes.lines[0].get_xdata().tolist() == [1.0, 7.0]


def test_objects_have_a_row_each_and_the_lively_come_first() -> None:
    def seen(
        number: int, verdict: str, frames: range, votes: int = 0, chamfer: float = float("nan")
    ) -> list[ObjectRow]:
        return [ObjectRow(10.0 + t, number, "person", verdict, votes, chamfer) for t in frames]

    stamps = [10.0 + t for t in range(10)]
    table = [
        *seen(1, "static", range(10)),
        *seen(2, "dynamic", range(4, 6), votes=3),
        *seen(3, "deforming", range(2, 9), chamfer=0.04),
    ]
    figure, left_out = draw_objects_over_time(stamps, table, 0.025)
    assert left_out == 0
    verdicts, votes, chamfer = figure.axes[:3]  # then the scales
    names = [[tick.get_text() for tick in axes.get_yticklabels()] for axes in (verdicts, votes, chamfer)]
    assert names == [["person 1", "person 2", "person 3"], ["person 2"], ["person 3"]]
    grid = np.ma.filled(verdicts.collections[0].get_array().reshape(3, 10), np.nan)
    order = list(MOTION_STATE_COLOURS)
    assert grid[0].tolist() == [order.index("static")] * 10
    assert np.flatnonzero(grid[1] == order.index("dynamic")).tolist() == [4, 5] and np.isnan(grid[1]).sum() == 8
    assert np.flatnonzero(grid[2] == order.index("deforming")).tolist() == list(range(2, 9))
    assert np.nanmax(np.ma.filled(chamfer.collections[0].get_array(), np.nan)) == 0.04
    crowd = [row for number in range(4, 40) for row in seen(number, "static", range(number % 7 + 1))]
    figure, left_out = draw_objects_over_time(stamps, [*table, *crowd], None)
    names = [tick.get_text() for tick in figure.axes[0].get_yticklabels()]
    assert left_out == 19 and len(names) == 20 and {"person 1", "person 2", "person 3"} <= set(names)


def test_times_of_stages_add_up() -> None:
    bars = draw_stage_bars({"read": 0.001, "objects": 0.05}).axes[0]
    assert [bar.get_width() for bar in bars.patches] == [1.0, 50.0]
    seconds = {"read": np.full(1000, 0.001), "objects": np.linspace(0, 0.1, 1000)}
    axes = draw_stages_over_time(np.arange(1000.0).tolist(), seconds).axes[0]
    highest = max(area.get_paths()[0].vertices[:, 1].max() for area in axes.collections)
    assert highest == pytest.approx(101, abs=0.5)  # milliseconds, all stages together
    share = draw_share(torch.arange(4.0), torch.tensor([0.0, 0.25, 0.5, 0.25])).axes[0]
    assert share.collections[0].get_paths()[0].vertices[:, 1].max() == 50


@pytest.mark.parametrize("frames", [1, 2])
def test_a_frame_or_two_are_drawn_too(frames: int) -> None:
    estimate = Trajectory(arc().stamps[:frames], arc().T_wc[:frames])
    table = [ObjectRow(float(estimate.stamps[0]), 1, "cup", "static", 0, float("nan"))]
    for name, figure in {
        "positions": draw_positions(None, estimate, None),
        "statuses": draw_statuses(estimate.stamps, ["tracked"] * frames, estimate.stamps[:1]),
        "objects": draw_objects_over_time(estimate.stamps.tolist(), table, None)[0],
        "stages": draw_stages_over_time(estimate.stamps.tolist(), {"read": np.ones(frames)}),
    }.items():
        assert inline_svg(figure, name).startswith("<svg")


# --- parts of a page


def test_svg_for_a_page_takes_its_colours_and_is_the_same_again() -> None:
    one, other = (inline_svg(draw_stage_bars({"read": 0.1}), "bars") for _ in range(2))
    assert one == other
    assert one.startswith("<svg") and one.rstrip().endswith("</svg>")
    assert "#000000" not in one and "currentColor" in one
    assert ">read</text>" in one  # letters are letters
    assert "fill: #ffffff" not in one


def test_images_for_a_page_are_data_and_a_broken_one_is_named(tmp_path: Path) -> None:
    colour = np.zeros((40, 60, 3), dtype=np.uint8)
    colour[:, :30] = (255, 0, 0)
    cv2.imwrite(str(tmp_path / "a.png"), colour[..., ::-1])
    kind, data = inline_image(tmp_path / "a.png").split(",")
    assert kind == "data:image/webp;base64"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), dtype=np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.abs(decoded.astype(int) - colour).mean() < 8
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:30])
    with pytest.raises(InputError, match=r"b\.png: is truncated or no image"):
        inline_image(tmp_path / "b.png")


def test_names_of_what_moves_are_drawn_over_those_of_what_stands_still() -> None:
    axes, mask = Figure().add_subplot(), torch.ones(12, 16, dtype=torch.bool)
    words = {"a": "dynamic", "b": "static", "c": "unknown", "d": "static"}
    draw_objects(axes, torch.zeros(3, 12, 16, dtype=torch.uint8), [(mask, name, said) for name, said in words.items()])
    assert [text.get_text() for text in axes.texts] == ["b", "d", "a", "c"]  # later over earlier
