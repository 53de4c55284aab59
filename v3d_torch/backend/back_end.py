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

from v3d_torch.backend.loop_closer import LoopCloser, LoopCorrection
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.culling import cull_redundant_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.local_bundle_adjustment import LocalAdjustment, local_bundle_adjust
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.runtime.stage_timer import StageTimer


@dataclass(frozen=True)
class BackEndResult:
    """What was found for a keyframe.

    Attributes:
        keyframe: it.
        adjustment: of its neighbourhood; None where there was none.
        closure: of the loop that ends at it; None without one.
        seconds: that each took.
    """

    keyframe: Keyframe
    adjustment: LocalAdjustment | None
    closure: LoopCorrection | None
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
        self._thread = ThreadPoolExecutor(1, "back-end") if config.prefetch else None
        self._result: Callable[[], BackEndResult] | None = None
        self.keyframe: Keyframe | None = None

    def submit(self, keyframe: Keyframe) -> None:
        """Begin to solve what the newest keyframe asks for; the map gets no other before `take_in`."""
        self.keyframe = keyframe
        work = partial(self._solve, keyframe, inference=torch.is_inference_mode_enabled())
        self._result = work if self._thread is None else self._thread.submit(work).result

    def result(self) -> BackEndResult | None:
        """What was solved, as soon as it is; None where nothing was to be."""
        return None if self._result is None else self._result()

    def apply(self, solved: BackEndResult) -> Tensor | None:
        """Change the map accordingly; then landmarks and keyframes go that it can do without.

        Returns:
            Where a loop was closed, the correction of the world at its end, new world from old, shape :math:`(4, 4)`.
        """
        self.keyframe = self._result = None
        if solved.adjustment is not None:
            solved.adjustment.apply(self._map)
        T_new_old = None if solved.closure is None else self._loops.correct_loop(solved.closure, self._map)
        self._map.cull_landmarks()
        cull_redundant_keyframes(self._map, solved.keyframe, self._config.mapping)
        self._loops.remove_keyframes({known.index for known in self._map.keyframes if known.is_culled})
        self._loops.add_keyframe(solved.keyframe)
        return T_new_old

    def _solve(self, keyframe: Keyframe, *, inference: bool) -> BackEndResult:
        clock = StageTimer()
        with torch.inference_mode(inference):
            with clock("bundle"):
                adjustment = local_bundle_adjust(self._map, keyframe, self._config, self._camera)
            with clock("loop"):
                T_cw = self._map.T_cw if adjustment is None else adjustment.T_cw
                closure = self._loops.detect_loop(keyframe, self._map, T_cw)
        return BackEndResult(keyframe, adjustment, closure, clock.seconds)
