"""Shared fixtures and settings; one thread, so that results are the same on every machine."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import typer.testing
from filelock import FileLock
from hypothesis import settings
from rich.console import Console

from v3d_torch.io.paths import cache_dir
from v3d_torch.runtime.hangup import HANGUP

if TYPE_CHECKING:
    from v3d_torch.datasets import RGBDSequence
    from v3d_torch.datasets.demo.renderer import Renderer
    from v3d_torch.datasets.demo.scene import Scene

# Threads that wait for each other would keep cores busy that other workers of the tests need. Read by torch's OpenMP.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Commands that tests start with caches of their own share the compiled kernels; read when kernels are imported.
os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_dir() / "kernels"))

# A call of a command in a test would build the command from its signature, which takes longer than many a command.
typer.testing._get_command = cache(typer.testing._get_command)  # type: ignore[attr-defined]

# A busy machine can be ten times as slow as an idle one.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

SLOWEST = (
    *("batch/test_ray_executor.py", "test_corpus.py", "cli/test_run.py", "project/test_notebooks.py"),
    *("project/test_module_table.py", "objects/test_classified_scenes.py", "project/test_privacy.py"),
    *("cli/test_batch.py", "test_real_sequences.py", "cli/test_run_resume.py", "cli/test_report.py"),
    *("objects/test_motion_classifier.py", "cli/test_ablate.py", "tracking/test_lost_camera.py"),
    *("backend/test_closed_loop.py", "project/test_docs.py", "live/test_interruptions.py", "cli/test_own_stages.py"),
    *("test_determinism.py", "test_modules.py", "project/test_any_bytes.py", "project/test_benchmarks.py"),
    *("segmentation/test_yolo.py", "odometry/test_dense_aligner.py", "viz/test_rerun_viewer.py"),
)
"""Files that run first, so that several workers (``-n 2``) finish at about the same time."""


def pytest_configure(config: pytest.Config) -> None:
    """Compile all kernels before the tests, whose time is limited; with ``-n``, the first worker does it."""
    if config.getoption("numprocesses", None):  # this process starts the workers, and runs no tests
        return
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by programs that a shell runs in the background
    for hangup in HANGUP:
        signal.signal(hangup, signal.SIG_DFL)  # ignored by nohup
    gc.disable()  # until all tests are collected
    # Imports that take seconds.
    import torch

    import v3d_torch.slam  # noqa: F401 - registers the kernels
    from v3d_torch.runs.kernel_compilation import compile_with_progress

    torch.set_num_threads(1)
    cache_dir().mkdir(parents=True, exist_ok=True)
    with FileLock(cache_dir() / "kernels-of-tests.lock"):
        compile_with_progress(Console(quiet=True))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Begin garbage collection once the tests are imported: they stay, and looking at them would take seconds."""
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slowest files first; tests within a file keep their order."""

    def order(item: pytest.Item) -> int:
        path = item.path.relative_to(Path(__file__).parent).as_posix()
        return SLOWEST.index(path) if path in SLOWEST else len(SLOWEST)

    items.sort(key=order)


collect_ignore = ["test_corpus.py"] if os.name == "nt" else []
"""Files that need Unix: full disks and little memory are simulated with its resource limits."""


@pytest.fixture(autouse=True)
def _same_start() -> None:
    """Give each test the same random numbers and one thread, so that a failure can be repeated, alone and in any order.

    Commands that other tests called in this process have set the number of threads.
    """
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def moment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of six frames of the demo with true masks, in which the walker is in the middle of the room."""
    from helpers.demo_frames import copy_frames

    folder = tmp_path_factory.mktemp("sequences") / "moment"
    copy_frames(folder, range(52, 58))
    return folder


@pytest.fixture(scope="module")
def demo() -> RGBDSequence:
    """Sequence of the demo."""
    from v3d_torch.datasets import load_sequence

    return load_sequence("demo")


@pytest.fixture(scope="session")
def walking_scene() -> Scene:
    """Scene of the demo, whose textures take seconds to build."""
    from v3d_torch.datasets.demo.scenes.walking import build_walking_scene
    from v3d_torch.datasets.demo.sequence import SEED

    return build_walking_scene(SEED)


@pytest.fixture(scope="module")
def renderer(walking_scene: Scene) -> Renderer:
    """Renderer of small images of this scene."""
    from helpers.demo_views import SMALL

    from v3d_torch.datasets.demo.renderer import Renderer

    return Renderer(walking_scene, SMALL)


def _draw_no_run(patch: pytest.MonkeyPatch) -> None:
    """Turn off the figures of runs, which take half of the time of short runs."""
    patch.setattr("v3d_torch.runs.results.draw_run", lambda *_: None)


@pytest.fixture(scope="module")
def no_figures() -> Iterator[None]:
    """Runs of a file without figures, those of its fixtures too."""
    with pytest.MonkeyPatch.context() as patch:
        _draw_no_run(patch)
        yield


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of a test without figures."""
    _draw_no_run(monkeypatch)


@pytest.fixture(scope="session")
def v3d_data() -> Path:
    """Folder of recorded and composed sequences: ``$V3D_DATA``, else ``../shared/data`` beside the checkout."""
    root = Path(os.environ.get("V3D_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"no real data: {root} is not there; set V3D_DATA to a folder of TUM-layout sequences")
    return root


@pytest.fixture(scope="session")
def real_sequence(v3d_data: Path) -> Callable[[str], Path]:
    """Function that returns the folder of a sequence in `v3d_data`, or skips the test if the folder is missing."""

    def find(name: str) -> Path:
        if not (v3d_data / name).is_dir():
            pytest.skip(f"no real data: {v3d_data / name} is missing")
        return v3d_data / name

    return find
