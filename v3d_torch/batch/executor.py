"""What carries out the runs of a batch: the interface, and the events that it tells of."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from threading import Event
from typing import Protocol

from v3d_torch.batch.job import Job

THREADS = dict.fromkeys(
    (*("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "OPENCV_FOR_THREADS_NUM", "RAYON_NUM_THREADS"),
    "1",
)
"""Environment of a run that shares its machine with others: no library starts threads of its own."""


@dataclass(frozen=True)
class JobProgress:
    """A run is under way and has done so many of its frames."""

    job: Job
    frames: int


@dataclass(frozen=True)
class Finished:
    """A run is over: with its results written, or with the sentence that it failed with."""

    job: Job
    failure: str | None


class Executor(Protocol):
    """Carries out jobs, each in a process of its own: what happens to one is nothing to the others."""

    def __call__(self, jobs: Sequence[Job], stop: Event) -> Generator[JobProgress | Finished]:
        """Tell what happens, as it happens. Runs under way are killed when the generator is closed.

        Args:
            jobs: to be carried out, the first ones first.
            stop: once it is set no more are started, and those under way end after their frame, with their results
                written. Jobs that were not started have no event.
        """
