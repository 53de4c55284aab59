"""Processing of a whole sequence: preprocessing ahead of tracking, records of the run, and a viewer."""

from __future__ import annotations

from v3d_torch.pipeline.pipeline import NULL_VIEWER, FrameCallback, NullViewer, Pipeline, Viewer, ViewerGroup
from v3d_torch.pipeline.run_record import FrameTimes, LiveTable, ObjectTable, RunRecord, Snapshot, StateTable

__all__ = [
    "NULL_VIEWER",
    "FrameCallback",
    "FrameTimes",
    "LiveTable",
    "NullViewer",
    "ObjectTable",
    "Pipeline",
    "RunRecord",
    "Snapshot",
    "StateTable",
    "Viewer",
    "ViewerGroup",
]
