"""Interface of the executors, which run the jobs of a batch, and the events that they report."""

from __future__ import annotations

import logging
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from threading import Event
from typing import Protocol

from v3d_torch.batch.job import Job
from v3d_torch.errors import OutputError
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.log import log_to

_LOG = logging.getLogger(__name__)

ONE_THREAD_ENVIRONMENT = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
        "RAYON_NUM_THREADS",
    ),
    "1",
)
"""Environment variables of a job that shares its machine with other jobs: libraries start no threads."""


@dataclass(frozen=True)
class JobProgress:
    """Progress of a running job.

    Attributes:
        job: The job.
        frames: Number of frames processed.
    """

    job: Job
    frames: int


@dataclass(frozen=True)
class JobFinished:
    """End of a job.

    Attributes:
        job: The job.
        failure: Error message of the job; None if its results are complete.
    """

    job: Job
    failure: str | None


@dataclass(frozen=True)
class JobRepeated:
    """A job whose process or machine died, and that is run once more.

    Attributes:
        job: The job.
        reason: Reason of the end.
    """

    job: Job
    reason: str

    def __str__(self) -> str:
        return f"{self.job}: {self.reason}; it is run once more"


def report_lost_process(job: Job, reason: str) -> JobFinished:
    """Write to the log of a job that its process died; the process itself cannot do it.

    Args:
        job: Job that the process ran.
        reason: Reason, for the log and the message.

    Returns:
        The end of the job.
    """
    with suppress(OutputError), log_to(job.folder / RunFile.LOG, append=True):
        _LOG.error(reason)
    return JobFinished(job, reason)


BatchEvent = JobProgress | JobFinished | JobRepeated
"""Event of a batch."""


class Executor(Protocol):
    """Runs each job in a process of its own, so that a crash affects one job only."""

    def __call__(self, jobs: Sequence[Job], stop: Event) -> Generator[BatchEvent]:
        """Run jobs and yield events as they happen. Closing the generator kills the running jobs.

        Args:
            jobs: Jobs to run, in order of priority.
            stop: Request to stop. Once it is set, no job starts, and running jobs end after their current frame and
                write their results. Jobs that did not start have no event.
        """
