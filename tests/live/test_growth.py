"""Size of the state in a long live run in one place: only poses and culled keyframes are added, also with occupancy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from itertools import chain, pairwise

import torch
from helpers.paced_frames import paced
from helpers.walk_with_loop import CAMERA, CONFIG, FORWARD, Walk, segment_red

from v3d_torch.config.loading import override_config
from v3d_torch.live import LiveSLAM
from v3d_torch.segmentation import UprightSegmenter
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame

TURN = 2 * (len(FORWARD) - 1)
"""Number of frames in which the camera walks along the wall and back."""

TURNS = 6
SETTLED = 2
"""Number of turns after which all histories are full: they contain 10 s, which are 100 frames."""

SAMPLING = 3
"""Sizes are measured on every third frame."""

GROWING = {"poses", "map"}
ALLOWANCE = {
    **dict.fromkeys(("classify_motion", "free_space_check", "occupancy", "states"), 600),
    **{"landmarks": 5, "observations": 5, "keyframes": 0.05},
}
"""Growth per frame that is allowed, bytes or number: contents of these parts vary from turn to turn. A keyframe, of
which there is one in three frames, creates up to 200 landmarks."""

OTHER_ALLOWANCE = 40
"""The same for all other parts, bytes: less than the size of a stored tensor."""


def back_and_forth() -> Iterator[RGBDFrame]:
    walk = Walk()
    for index in range(TURNS * TURN):
        position = min(index % TURN, TURN - index % TURN)
        yield replace(walk[position], index=index, stamp=index / 10)


def test_state_of_a_long_run_in_one_place_stays_bounded() -> None:
    config = override_config(CONFIG, ["occupancy.enabled=true", "occupancy.interval=1", "occupancy.max_views=20"])
    slam = V3DSLAM(CAMERA, UprightSegmenter(segment_red), config)
    turns: list[list[dict[str, int]]] = [[] for _ in range(TURNS)]
    for result in LiveSLAM(paced(back_and_forth(), slam), slam):
        turn, position = divmod(result.frame.index, TURN)
        if position == TURN - 1 or (turn >= SETTLED and position % SAMPLING == 0):
            size = {name: stored_size(state) for name, state in slam.state_dict().items()}
            size["landmarks"], size["observations"] = len(slam.map.landmarks), len(slam.map.observations)
            size["keyframes"] = len(slam.map.active_keyframes)
            # The poses refer to the keyframes, whose number varies.
            size["poses"] -= stored_size(list(slam.map.active_keyframes))
            turns[turn].append(size)
    half = (TURNS - SETTLED) // 2
    earlier, later = (list(chain(*part)) for part in (turns[SETTLED : SETTLED + half], turns[SETTLED + half :]))
    assert len(earlier) == len(later) == half * len(turns[-1])
    for name in earlier[0].keys() - GROWING:
        growth = max(size[name] for size in later) - max(size[name] for size in earlier)
        assert growth <= ALLOWANCE.get(name, OTHER_ALLOWANCE) * half * TURN, name
    ends = [sizes[-1] for sizes in turns]
    for before, after in pairwise(ends):
        assert 0 < after["poses"] - before["poses"] < 1500 * TURN
    culled = len(slam.map.keyframes) - ends[-1]["keyframes"]
    assert culled > ends[-1]["keyframes"]


def stored_size(state: object) -> int:
    """Size of a state in a file, bytes."""
    file = BytesIO()
    torch.save(state, file)
    return file.tell()
