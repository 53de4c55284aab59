"""Times and errors of the camera modules beside theseus, PyPose, GTSAM, OpenCV, Kornia, kornia-rs, Open3D and evo.

``python benchmarks/modules.py`` prints a table for batches of 1, 8 and 64 problems, with one thread. All
implementations get the same problems and take turns in random order, so that a busy machine slows all of them. A time
is the median over the turns, in which calls shorter than 20 ms are repeated; ``ratio`` is the median of the peer's time
divided by ours in the same turn: above 1 ours is faster. Peers without batches solve the problems one after the other.
Factor graphs of GTSAM and theseus are built beforehand.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from statistics import median

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import torch
import typer
from heading import make_heading
from module_problems import PROBLEMS
from rich.console import Console
from rich.table import Table
from storage import Measurement, Row
from storage import save as store
from timing import OURS, take_turns

BATCHES = (1, 8, 64)

MAX_SECONDS = 20.0
"""Maximum time of a turn, seconds; peers that take longer are left out of larger batches."""

NOT_INSTALLED = (
    "gradslam 0.1.0 and PyTorch3D are no peers here: gradslam needs chamferdist, whose extension does not build without"
    " CUDA, and PyPI has no PyTorch3D for this Python."
)


def problems(functions: list[str], batches: list[int]) -> Iterator[Row]:
    """Measure all functions with all batch sizes, and yield the rows."""
    for name in functions:
        slow: set[str] = set()
        for batch in batches:
            implementations, error = PROBLEMS[name](batch)
            chosen = {key: solve for key, solve in implementations.items() if key not in slow}
            errors = {key: error(solve()) for key, solve in chosen.items()}
            times = take_turns(chosen, turns=3)
            for key, values in times.items():
                ratio = median(theirs / ours for theirs, ours in zip(values, times[OURS], strict=True))
                if median(values) * batches[-1] / batch > 1e3 * MAX_SECONDS:
                    slow.add(key)
                cells = {"ms": f"{median(values):.2f}", "ratio": f"{ratio:.2f}", "error": f"{errors[key]:.3g}"}
                yield {"function": name, "batch": str(batch), "implementation": key} | cells


def main(
    functions: list[str] = typer.Option(list(PROBLEMS), "--function", help="Function to measure, repeatable."),  # noqa: B008
    batches: list[int] = typer.Option(list(BATCHES), "--batch", help="Batch size, repeatable."),  # noqa: B008
    save: bool = typer.Option(False, "--save", help="Store the rows in benchmarks/results."),
) -> None:
    """Measure the camera modules and print a table."""
    heading = make_heading(("theseus-ai", "pypose", "gtsam", "opencv-python-headless", "kornia_rs", "open3d", "evo"))
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    rows = list(problems(functions, batches))
    table = Table("function", "batch", "implementation", "ms", "ratio", "error", title="threads: 1")
    for row in rows:
        table.add_row(*row.values(), end_section=False)
    Console().print(table)
    if save:
        store("modules", Measurement(heading, rows, [NOT_INSTALLED]))


if __name__ == "__main__":
    typer.run(main)
