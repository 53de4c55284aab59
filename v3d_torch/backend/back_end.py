"""Background optimisation: local bundle adjustment and loop closing, run while tracking continues.

In ORB-SLAM2 each of them has a thread that changes the map as soon as it has finished. Here the computation does not
change the map; its result is applied at one fixed point: when the next frame is tracked, before it is matched against
the map. Therefore the results do not depend on when and in which thread the computation runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from v3d_torch.backend.loop_closer import LoopCloser, LoopCorrection
from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.mapping.culling import cull_landmarks, cull_redundant_keyframes
from v3d_torch.mapping.keyframe import Keyframe
from v3d_torch.mapping.local_bundle_adjustment import LocalAdjustment, local_bundle_adjust
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.runtime.inference_mode import in_current_mode
from v3d_torch.runtime.stage_timer import StageTime, StageTimer


@dataclass(frozen=True)
class BackEndResult:
    """Result of the background optimisation for one keyframe.

    Attributes:
        keyframe: Keyframe that this result belongs to.
        adjustment: Local bundle adjustment around the keyframe; None if there was nothing to adjust.
        loop_correction: Loop that ends at the keyframe, with corrected poses; None if no loop was detected.
        times: Computation time of each stage, by name of the stage.
    """

    keyframe: Keyframe
    adjustment: LocalAdjustment | None
    loop_correction: LoopCorrection | None
    times: dict[str, StageTime]


class BackEnd:
    """Optimises the map around new keyframes and closes loops.

    Args:
        config: Configuration of the whole system.
        camera: Camera of the frames.
        sparse_map: Map to optimise.
        loop_closer: Loop closer of the same map.

    Attributes:
        keyframe: Keyframe whose result is pending; None if there is none.
    """

    def __init__(self, config: Config, camera: PinholeCamera, sparse_map: SparseMap, loop_closer: LoopCloser) -> None:
        self._config = config
        self._camera = camera
        self._map = sparse_map
        self._loop_closer = loop_closer
        self._executor = ThreadPoolExecutor(1, "back-end") if config.prefetch else None
        self._get_result: Callable[[], BackEndResult] | None = None
        self.keyframe: Keyframe | None = None

    def submit(self, keyframe: Keyframe) -> None:
        """Start the optimisation for the newest keyframe; the map must not change until its result is applied."""
        self.keyframe = keyframe
        optimise = in_current_mode(partial(self._optimise, keyframe))
        self._get_result = optimise if self._executor is None else self._executor.submit(optimise).result

    def result(self) -> BackEndResult | None:
        """Wait for the pending result and return it; None if no keyframe is pending.

        An error of the computation is raised once; no keyframe is pending then, so that the map can still be used.
        """
        if self._get_result is None:
            return None
        try:
            return self._get_result()
        except Exception:
            self.keyframe = self._get_result = None
            raise

    def apply(self, result: BackEndResult) -> Tensor | None:
        """Change the map according to a result, then cull landmarks and redundant keyframes.

        Returns:
            If a loop was closed, the transform ``T_new_old`` from the old to the corrected world frame at the end of
            the loop, float64, shape :math:`(4, 4)`; else None.
        """
        self.keyframe = self._get_result = None
        if result.adjustment is not None:
            result.adjustment.apply(self._map)
        T_new_old = None
        if result.loop_correction is not None:
            T_new_old = self._loop_closer.correct_loop(result.loop_correction, self._map)
        cull_landmarks(self._map)
        cull_redundant_keyframes(self._map, result.keyframe, self._config.mapping)
        self._loop_closer.remove_keyframes({keyframe.index for keyframe in self._map.keyframes if keyframe.is_culled})
        self._loop_closer.add_keyframe(result.keyframe)
        return T_new_old

    def discard(self) -> None:
        """Wait until the pending computation has ended, and discard its result; then the map may change."""
        if self._executor is not None:
            self._executor.submit(bool).result()  # it runs after the pending computation, in the same thread
        self.keyframe = self._get_result = None

    def state_dict(self) -> dict[str, Any]:
        """Return the pending keyframe, ``{"keyframe": Keyframe | None}``: the same object as in the map."""
        return {"keyframe": self.keyframe}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `state_dict`: rebuild the database of place recognition, and submit the pending keyframe.

        Load the map and the loop closer first. The pending keyframe must be the object in the map.
        """
        self.discard()
        pending = state["keyframe"]
        # The database has the pending keyframe only after its result was applied.
        self._loop_closer.rebuild_database(each for each in self._map.active_keyframes if each is not pending)
        if pending is not None:
            self.submit(pending)

    def _optimise(self, keyframe: Keyframe) -> BackEndResult:
        """Adjust the map around a keyframe and detect a loop; the map itself does not change."""
        timer = StageTimer()
        with timer("bundle"):
            adjustment = local_bundle_adjust(self._map, keyframe, self._config, self._camera)
        with timer("loop"):
            T_cw = self._map.T_cw if adjustment is None else adjustment.T_cw
            loop_correction = self._loop_closer.detect_loop(keyframe, self._map, T_cw)
        return BackEndResult(keyframe, adjustment, loop_correction, timer.times)
