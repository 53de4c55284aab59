"""What may take its time: bundle adjustment and loops, solved while the camera is followed on.

ORB-SLAM2 has a thread for each, which change the map whenever they are done. Here all that is solved for a keyframe is
worked out beside the map and taken in at one place: before the next frame is looked for in the map. So it makes no
difference to the results when it is worked out, and by which thread.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from v3d_torch.camera import PinholeCamera
from v3d_torch.config import Config
from v3d_torch.loop.closing import Closure, LoopCloser
from v3d_torch.mapping.adjust import Adjustment, adjust_locally
from v3d_torch.mapping.culling import cull_keyframes
from v3d_torch.mapping.local_map import Keyframe, SparseMap
from v3d_torch.timing import StageClock


@dataclass(frozen=True)
class Solved:
    """What was found for a keyframe.

    Attributes:
        keyframe: it.
        adjustment: of its neighbourhood; None where there was none.
        closure: of the loop that ends at it; None without one.
        seconds: that each took.
    """

    keyframe: Keyframe
    adjustment: Adjustment | None
    closure: Closure | None
    seconds: dict[str, float]


class BackEnd:
    """Adjusts the map around new keyframes, and closes loops.

    Args:
        config: of the whole system.
        camera: of the frames.
        sparse_map: of the system.
        loops: finds places again.

    Attributes:
        keyframe: for which something is being solved; None for none.
    """

    def __init__(self, config: Config, camera: PinholeCamera, sparse_map: SparseMap, loops: LoopCloser) -> None:
        self._config = config
        self._camera = camera
        self._map = sparse_map
        self._loops = loops
        self._thread = ThreadPoolExecutor(1, "back-end") if config.lookahead else None
        self._result: Callable[[], Solved] | None = None
        self.keyframe: Keyframe | None = None

    def begin(self, keyframe: Keyframe) -> None:
        """Begin to solve what the newest keyframe asks for; the map gets no other before `take_in`."""
        self.keyframe = keyframe
        work = partial(self._solve, keyframe, inference=torch.is_inference_mode_enabled())
        self._result = work if self._thread is None else self._thread.submit(work).result

    def result(self) -> Solved | None:
        """What was solved, as soon as it is; None where nothing was to be."""
        return None if self._result is None else self._result()

    def take_in(self, solved: Solved) -> Tensor | None:
        """Change the map accordingly; then landmarks and keyframes go that it can do without.

        Returns:
            Where a loop was closed, the correction of the world at its end, new world from old, shape :math:`(4, 4)`.
        """
        self.keyframe = self._result = None
        if solved.adjustment is not None:
            solved.adjustment.take_in(self._map)
        T_new_old = None if solved.closure is None else self._loops.close(solved.closure, self._map)
        self._map.cull()
        cull_keyframes(self._map, solved.keyframe, self._config.mapping)
        self._loops.forget({known.index for known in self._map.keyframes if known.retired})
        self._loops.learn(solved.keyframe)
        return T_new_old

    def _solve(self, keyframe: Keyframe, *, inference: bool) -> Solved:
        clock = StageClock()
        with torch.inference_mode(inference):
            with clock("bundle"):
                adjustment = adjust_locally(self._map, keyframe, self._config, self._camera)
            with clock("loop"):
                T_cw = self._map.T_cw if adjustment is None else adjustment.T_cw
                closure = self._loops.look(keyframe, self._map, T_cw)
        return Solved(keyframe, adjustment, closure, clock.seconds)
