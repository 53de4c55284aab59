"""Unused memory of the C library is returned to the system."""

from __future__ import annotations

import platform
import sys

import psutil
import pytest

from v3d_torch import V3DSLAM, load_sequence
from v3d_torch.config.loading import load_config
from v3d_torch.datasets.realtime_playback import RealtimePlayback
from v3d_torch.pipeline import Pipeline
from v3d_torch.runtime import process
from v3d_torch.runtime.process import trim_memory


def resident_mb() -> float:
    return float(psutil.Process().memory_info().rss / 2**20)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps free pages")
def test_trim_memory_returns_free_pages_between_used_blocks() -> None:
    blocks = [bytearray(b"x" * 60_000) for _ in range(4000)]
    used = blocks[::20]  # pages between these are free, and not at the end of the heap
    del blocks
    before = resident_mb()
    trim_memory()
    assert before - resident_mb() > 100
    assert all(block[-1] == ord("x") for block in used)


@pytest.mark.parametrize("platform", ["win32", "darwin"])
def test_trim_memory_does_nothing_on_other_systems(platform: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr("v3d_torch.runtime.process.ctypes.CDLL", None)
    trim_memory()


def test_trim_memory_does_nothing_with_other_c_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("v3d_torch.runtime.process.ctypes.CDLL", lambda name: object())
    trim_memory()


@pytest.mark.parametrize("live", [False, True])
def test_pipeline_trims_memory_at_intervals(live: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    demo, trimmed_after = load_sequence("demo"), []
    config = load_config(None, ["segmentation.source=none"])
    pipeline = Pipeline(RealtimePlayback(demo) if live else demo, V3DSLAM(demo.camera, config=config))
    monkeypatch.setattr(process, "_TRIM_INTERVAL", 3)
    monkeypatch.setattr(process, "trim_memory", lambda: trimmed_after.append(len(pipeline.record.times)))

    def stop(*_: object) -> None:
        if len(pipeline.record.times) == 8:
            raise KeyboardInterrupt

    assert pipeline(stop).interrupted and trimmed_after == [3, 6]
