from __future__ import annotations

import numpy as np
import pytest
import torch

from v3d_torch.config import TrackerConfig
from v3d_torch.objects.frame_objects import FrameObjects, MotionState, TrackedObject
from v3d_torch.objects.kalman_filter import ConstantVelocityKalmanFilter
from v3d_torch.objects.object_state import ObjectState
from v3d_torch.pipeline.run_record import FrameTimes, LiveTable, ObjectTable
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.types import RGBDFrame


def test_stages_that_did_not_run_on_a_frame_took_no_time() -> None:
    image, depth = torch.zeros(3, 1, 1), torch.zeros(1, 1, 1)
    times = FrameTimes()
    times.append(RGBDFrame(3, 0.1, image, depth), {"read": StageTime(1.0, 0.5)})
    times.append(RGBDFrame(4, 0.2, image, depth), {})
    times.append(RGBDFrame(5, 0.3, image, depth), {"loop": StageTime(2.0, 1.5), "read": StageTime(3.0, 2.5)})
    assert len(times) == 3
    assert times.indices.tolist() == [3, 4, 5]
    assert times.stamps.tolist() == [0.1, 0.2, 0.3]
    assert times.stages == ["read", "loop"]
    assert times.wall.tolist() == [[1.0, 0.0], [0.0, 0.0], [3.0, 2.0]]
    assert times.cpu.tolist() == [[0.5, 0.0], [0.0, 0.0], [2.5, 1.5]]


def test_values_of_an_object_without_a_centroid_are_nan() -> None:
    """As of furniture of which too little was measured, and that is predicted to stay where it is."""
    mask = torch.zeros(1, 1, dtype=torch.bool)
    state = ConstantVelocityKalmanFilter(TrackerConfig()).state.predict_at_rest(0.1)
    chair = TrackedObject(1, 56, mask, state, (), 0, 0.1, MotionState.STATIC, missed=False, cloud=torch.zeros(0, 3))
    table = ObjectTable()
    frame = RGBDFrame(0, 0.1, torch.zeros(3, 1, 1), torch.zeros(1, 1, 1))
    table.append_objects(frame, FrameObjects([chair], mask, mask, []), torch.tensor([0.0, -1.0, 0.0]))
    for column in ("centroid", "velocity", "sigmas", "box"):
        assert table[column].isnan().all(), column


def test_row_of_an_object_has_its_votes_and_its_box() -> None:
    mask, up = torch.zeros(1, 1, dtype=torch.bool), torch.tensor([0.0, -1.0, 0.0])
    position, velocity = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    state = ObjectState(0.1, position, velocity, (1e-4, 0.0, 1e-2), 1.0)
    along = torch.linspace(-0.5, 0.5, 9)[:, None]
    cloud = along * torch.tensor([[0.8, 0.0, 0.6]]) + position.float()
    cloud = torch.cat([cloud, cloud + torch.tensor([0.0, 0.3, 0.0])])  # an upright board, 1 m long
    board = TrackedObject(4, 56, mask, state, (), 3, 0.1, MotionState.DYNAMIC, missed=False, cloud=cloud)
    found, table = FrameObjects([board], mask, mask, []), ObjectTable()
    table.append_objects(RGBDFrame(0, 0.1, torch.zeros(3, 1, 1), torch.zeros(1, 1, 1)), found, up)
    (box,) = found.boxes(up).values()
    assert abs(box.yaw) > 0.5
    expected = [*box.T_wb[:3, 3].tolist(), *box.size.tolist(), box.yaw]
    assert table["box"].tolist() == [expected] and table["votes"].tolist() == [3]


@pytest.mark.parametrize("name", ["pose_latency", "latency"])
def test_statistics_of_latencies_are_those_of_numpy(name: str) -> None:
    table = LiveTable()
    assert table.statistics(name) is None
    pose_latency, latency = torch.rand(2, 101, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    table.append(pose_latency=pose_latency, latency=latency, dropped=torch.zeros(101, dtype=torch.int64))
    values = table[name].numpy()
    expected = {"median": np.median(values), "p95": np.percentile(values, 95), "max": values.max()}
    assert table.statistics(name) == pytest.approx(expected)
