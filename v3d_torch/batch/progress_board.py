"""Actor of a Ray cluster that collects the progress of jobs.

A module of its own, because its process imports this module: the other modules of the package would take seconds and
hundreds of megabytes.
"""

from __future__ import annotations


class ProgressBoard:
    """Ray actor that collects the progress of the running jobs."""

    def __init__(self) -> None:
        self._frames: dict[int, int] = {}

    def report(self, index: int, frames: int) -> None:
        """Store the number of frames that a job has processed."""
        self._frames[index] = frames

    def take(self) -> dict[int, int]:
        """Return and clear the frames processed, by job, of the jobs that reported since the last call."""
        reports, self._frames = self._frames, {}
        return reports
