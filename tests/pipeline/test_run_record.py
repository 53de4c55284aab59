from __future__ import annotations

import torch

from v3d_torch.pipeline.run_record import FrameTimes
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
