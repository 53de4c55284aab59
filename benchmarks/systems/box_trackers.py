"""Trackers of boxes in the image, from the package ``trackers``, fed with given detections."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from v3d_torch.types import Instances, RGBDFrame

PEERS = ("ByteTrack", "OC-SORT", "BoT-SORT")
"""Trackers that the benchmark runs."""

SETTINGS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "defaults": {name: {} for name in PEERS},
    # The network of this package returns detections from a score of 0.25 on. Between two thresholds, detections only
    # continue tracks.
    "low scores": {
        "ByteTrack": {"high_conf_det_threshold": 0.4, "track_activation_threshold": 0.4},
        "OC-SORT": {"high_conf_det_threshold": 0.25},
        "BoT-SORT": {"high_conf_det_threshold": 0.4, "track_activation_threshold": 0.4},
    },
}
"""Settings of each tracker in addition to its defaults; the benchmark shows the best setting for each sequence."""


class BoxTracker:
    """Tracker of people by their boxes.

    Args:
        name: One of `PEERS`.
        settings: Settings in addition to the defaults.
        rate: Frames per second.
    """

    def __init__(self, name: str, settings: Mapping[str, float], rate: float) -> None:
        import trackers

        makers: dict[str, Callable[..., Any]] = {
            "ByteTrack": trackers.ByteTrackTracker,
            "OC-SORT": trackers.OCSORTTracker,
            "BoT-SORT": trackers.BoTSORTTracker,
        }
        self._tracker = makers[name](frame_rate=rate, **settings)
        self._uses_image = name == "BoT-SORT"

    def __call__(self, frame: RGBDFrame, people: Instances) -> dict[int, int]:
        """Track a frame.

        Args:
            frame: Frame; only BoT-SORT uses its image, for the motion of the camera.
            people: People that the network found.

        Returns:
            Index of the instance of each track by the id of the track.
        """
        import supervision

        detections = supervision.Detections(
            xyxy=people.boxes.numpy().reshape(-1, 4),
            confidence=people.scores.numpy(),
            class_id=np.zeros(len(people), int),
            data={"index": np.arange(len(people))},
        )
        image = {"frame": frame.image.permute(1, 2, 0).flip(-1).contiguous().numpy()} if self._uses_image else {}
        tracked = self._tracker.update(detections, **image)
        if len(tracked) == 0:
            return {}
        pairs = zip(tracked.tracker_id.tolist(), tracked.data["index"].tolist(), strict=True)
        return {id_: index for id_, index in pairs if id_ >= 0}
