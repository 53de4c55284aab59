"""Frames of the demo, copied from the cache: it is rendered at most once for all tests."""

from __future__ import annotations

import shutil
from pathlib import Path

from filelock import FileLock

from v3d_torch.datasets.demo import ensure_demo
from v3d_torch.datasets.demo.sequence import FRAME_RATE, START_STAMP
from v3d_torch.io.paths import cache_dir

_IMAGES = ("rgb", "depth", "masks", "instances")
_LISTS = ("rgb.txt", "depth.txt", "associations.txt", "groundtruth.txt")


def copy_frames(folder: Path, frames: range) -> None:
    """Copy frames of the demo into a folder, with the same files as `write_sequence` renders.

    Args:
        folder: Folder in TUM layout; created if missing.
        frames: Indices of the frames, ascending.
    """
    cache = cache_dir()
    cache.mkdir(parents=True, exist_ok=True)
    with FileLock(cache / "demo-of-tests.lock"):  # several workers do not render it at the same time
        demo = ensure_demo(cache)
    stamps = {f"{START_STAMP + index / FRAME_RATE:.6f}" for index in frames}
    for kind in _IMAGES:
        (folder / kind).mkdir(parents=True, exist_ok=True)
        for path in (demo / kind).iterdir():
            if path.stem in stamps:
                shutil.copyfile(path, folder / kind / path.name)
    for name in _LISTS:
        rows = (demo / name).read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [row for row in rows if row.startswith("#") or row.split()[0] in stamps]
        (folder / name).write_text("".join(kept), encoding="utf-8")
    for name in ("camera.yaml", "instances/labels.yaml"):
        shutil.copyfile(demo / name, folder / name)
