"""Plots of poses over time: errors, positions, tracking status, masked fraction."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.trajectories import arc, shaken

from v3d_torch.evaluation import evaluate
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.types import Trajectory
from v3d_torch.viz.figure_output import embed_svg
from v3d_torch.viz.pose_timelines import draw_errors, draw_masked_fraction, draw_positions, draw_statuses
from v3d_torch.viz.time_axes import frame_cells


def test_errors_equal_distances_after_alignment() -> None:
    """Against NumPy: Kabsch's rotation, then the difference of positions."""
    truth = arc()
    truth.T_wc[1:, :3, :3] = se3_exp(torch.tensor([0, 0, 0, 1e-7, 0, 0], dtype=torch.float64))[
        :3, :3
    ]  # not a placeholder
    estimate = shaken(truth)
    evaluation = evaluate(truth, estimate)
    position, translation, rotation = draw_errors(truth, estimate, evaluation, ["tracked"] * 60).axes
    g, e = (t.T_wc[:, :3, 3].numpy() for t in (truth, estimate))
    U, _, Vt = np.linalg.svd((g - g.mean(0)).T @ (e - e.mean(0)))
    aligned = (e - e.mean(0)) @ (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T + g.mean(0)
    np.testing.assert_allclose(position.lines[0].get_ydata(), np.linalg.norm(aligned - g, axis=1), atol=1e-9)
    np.testing.assert_allclose(position.lines[1].get_ydata(), evaluation.ate.rmse)
    # There is hardly any rotation, so the drift is the difference of the motions over 15 frames, about one second.
    motions = (e[15:-1] - e[:-16]) - (g[15:-1] - g[:-16])
    np.testing.assert_allclose(translation.lines[0].get_ydata(), np.linalg.norm(motions, axis=1), atol=1e-6)
    np.testing.assert_allclose(rotation.lines[0].get_ydata(), 0, atol=1e-5)
    assert [axes.lines[0].get_xdata()[0] for axes in (position, translation, rotation)] == [0, 0, 0]


def test_untracked_frames_are_shaded() -> None:
    truth, estimate = arc(), shaken(arc())
    statuses = ["tracked"] * 50 + ["lost"] * 10
    shaded = draw_errors(truth, estimate, evaluate(truth, estimate), statuses).axes[0].collections
    assert len(shaded) == 1 and len(shaded[0].get_paths()) == 10
    start = shaded[0].get_paths()[0].vertices[:, 0].min()
    assert start == pytest.approx(49.5 * 4 / 59, abs=1e-6)


def test_positions_are_drawn_in_world_frame_of_ground_truth() -> None:
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


def test_statuses_and_keyframes_are_drawn_and_counted() -> None:
    stamps = torch.arange(10, dtype=torch.float64) + 5
    statuses = ["lost"] + ["tracked"] * 8 + ["disconnected"]
    figure = draw_statuses(stamps, statuses, stamps[[1, 7]])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["8 tracked", "1 disconnected", "1 lost", "2 keyframes"]
    axes = figure.axes[0]
    assert np.ravel(axes.collections[0].get_array()).tolist() == [3.0] + [0.0] * 8 + [2.0]
    assert axes.lines[0].get_xdata().tolist() == [1.0, 7.0]


def test_masked_fraction_is_drawn_in_percent() -> None:
    axes = draw_masked_fraction(torch.arange(4.0), torch.tensor([0.0, 0.25, 0.5, 0.25])).axes[0]
    assert axes.collections[0].get_paths()[0].vertices[:, 1].max() == 50


@pytest.mark.parametrize("frames", [1, 2])
def test_one_or_two_frames_are_drawn(frames: int) -> None:
    estimate = Trajectory(arc().stamps[:frames], arc().T_wc[:frames])
    for name, figure in {
        "positions": draw_positions(None, estimate, None),
        "statuses": draw_statuses(estimate.stamps, ["tracked"] * frames, estimate.stamps[:1]),
    }.items():
        assert embed_svg(figure, name).startswith("<svg")
        if name == "statuses":
            assert [text.get_text() for text in figure.legends[0].get_texts()][-1] == "1 keyframe"
        else:  # a line needs two points to be visible, a marker one
            assert all(frames > 1 or axes.lines[0].get_marker() == "." for axes in figure.axes)


def test_cells_of_frames_leave_gaps_empty() -> None:
    """Frames at 0, 1, 2, 10 and 11 s: the cells of the frames beside the gap end after a second."""
    edges, cells = frame_cells([0, 1, 2, 10, 11], np.array([[1.0, 2, 3, 4, 5]]))
    assert edges.tolist() == [-0.5, 0.5, 1.5, 3, 9, 10.5, 11.5]
    np.testing.assert_array_equal(cells, [[1, 2, 3, np.nan, 4, 5]])


def test_curves_and_bars_are_interrupted_at_the_same_gaps() -> None:
    """Dropped frames, here three, are no gap; eight seconds without any are one."""
    stamps = torch.tensor([0, 1, 2, 3, 7, 8, 9, 17, 18, 19], dtype=torch.float64)
    (curve,) = draw_positions(None, Trajectory(stamps, arc().T_wc[:10]), None).axes[0].lines
    bars = draw_statuses(stamps, ["tracked"] * 10, stamps[:1]).axes[0].collections[0].get_array()
    for values in (curve.get_ydata(), np.ma.filled(bars, np.nan).ravel()):
        assert np.flatnonzero(np.isnan(values)).tolist() == [7]
    areas = draw_masked_fraction(stamps, torch.full((10,), 0.5)).axes[0].collections[0].get_paths()
    assert [area.vertices[:, 0].max() for area in areas] == [9, 19]


def test_cells_of_regular_frames_touch() -> None:
    edges, cells = frame_cells([0.0], np.array([[7.0]]))
    assert edges.tolist() == [-0.5, 0.5] and cells.tolist() == [[7.0]]
    edges, cells = frame_cells([0, 2, 4], np.array([[1.0, 2, 3]]))
    assert edges.tolist() == [-1, 1, 3, 5] and cells.tolist() == [[1, 2, 3]]
