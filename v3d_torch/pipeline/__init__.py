"""Processing of a whole sequence: preprocessing ahead of tracking, records of the run, and a viewer."""

from __future__ import annotations

from v3d_torch.pipeline.pipeline import FrameCallback, Pipeline
from v3d_torch.pipeline.run_record import FrameTimes, LiveTable, ObjectTable, RunRecord, Snapshot, StateTable
from v3d_torch.pipeline.viewer import Viewer, ViewerGroup

__all__ = [
    "FrameCallback",
    "FrameTimes",
    "LiveTable",
    "ObjectTable",
    "Pipeline",
    "RunRecord",
    "Snapshot",
    "StateTable",
    "Viewer",
    "ViewerGroup",
]
