"""Size of the state in a long live run in one place: only poses and culled keyframes are added, also with occupancy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from itertools import pairwise

import torch
from helpers.paced_frames import paced
from helpers.walk_run import CAMERA, CONFIG, FORWARD, Walk, segment_red

from v3d_torch.config.loading import override_config
from v3d_torch.live import LiveSLAM
from v3d_torch.segmentation import UprightSegmenter
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame

TURN = 2 * (len(FORWARD) - 1)
"""Number of frames in which the camera walks along the wall and back."""

TURNS = 4

GROWING = {"poses", "map"}
"""Components that keep something of each frame, or of each culled keyframe."""

VARYING = {
    *("free_space_check", "classify_motion", "back_end", "occupancy"),
    *("landmarks", "observations", "keyframes"),
}
"""Components whose size depends on what is in view, and numbers of what is in the map."""


def back_and_forth() -> Iterator[RGBDFrame]:
    walk = Walk()
    for index in range(TURNS * TURN):
        position = min(index % TURN, TURN - index % TURN)
        yield replace(walk[position], index=index, stamp=index / 10)


def test_state_of_a_long_run_in_one_place_stays_bounded() -> None:
    config = override_config(CONFIG, ["occupancy.enabled=true", "occupancy.interval=1", "occupancy.max_views=20"])
    slam = V3DSLAM(CAMERA, UprightSegmenter(segment_red), config)
    sizes: list[dict[str, int]] = []
    for result in LiveSLAM(paced(back_and_forth(), slam), slam):
        if (result.frame.index + 1) % TURN == 0:
            size = {name: stored_size(state) for name, state in slam.state_dict().items()}
            size["landmarks"], size["observations"] = len(slam.map.landmarks), len(slam.map.observations)
            size["keyframes"] = len(slam.map.active_keyframes)
            size["poses"] -= stored_size(
                list(slam.map.active_keyframes)
            )  # the poses refer to them; their number varies
            sizes.append(size)
    assert len(sizes) == TURNS
    *_, earlier, last = sizes
    for name in last.keys() - GROWING - VARYING:
        assert last[name] - earlier[name] < 4 * TURN, name  # bytes: nothing of a frame fits into four
    for name in VARYING:
        assert last[name] <= 1.4 * max(size[name] for size in sizes[:-1]), name
    for before, after in pairwise(sizes):
        assert 0 < after["poses"] - before["poses"] < 1500 * TURN
    culled = len(slam.map.keyframes) - sizes[-1]["keyframes"]
    assert culled > sizes[-1]["keyframes"]


def stored_size(state: object) -> int:
    """Size of a state in a file, bytes."""
    file = BytesIO()
    torch.save(state, file)
    return file.tell()
