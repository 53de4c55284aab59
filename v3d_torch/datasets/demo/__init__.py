"""The built-in sequence: a furnished room, three people, a hand-held camera; made on first use, no download."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from pathlib import Path

from v3d_torch.datasets.demo.sequence import Progress, write_sequence
from v3d_torch.errors import OutputError


def ensure_demo(cache_dir: Path, progress: Progress | None = None) -> Path:
    """The demo sequence, rendered once and kept.

    The folder's name carries a hash of the code and the photographs it is made from, so that a newer version of either
    never meets an older one's images.

    Args:
        cache_dir: where the sequence is kept; made if need be.
        progress: called with (frames done, frames) while it is rendered.

    Returns:
        A folder in TUM layout: ``rgb/*.jpg``, ``depth/*.png`` (16 bit, 5000 units per metre, 0 = none), ``rgb.txt``,
        ``depth.txt``, ``associations.txt``, ``groundtruth.txt`` (camera-to-world), ``camera.yaml``, and
        ``masks/*.png``: the truth of moving pixels (0 static, 1 the person who walks, 2 the one who sways).

    Raises:
        OutputError: the folder cannot be written.
    """
    sequence = cache_dir / f"demo-{_version()}"
    if sequence.is_dir():
        return sequence
    try:
        cache_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".demo-", dir=cache_dir) as temporary:
            folder = Path(temporary) / "sequence"
            write_sequence(folder, progress=progress)
            _publish(folder, sequence)
    except OSError as error:
        raise OutputError(
            f"{cache_dir}: cannot keep the demo sequence there ({error}); free some space or name another cache folder."
        ) from error
    return sequence


def _publish(folder: Path, sequence: Path) -> None:
    """Rename; where another process was faster, its sequence has the same bytes and stays."""
    try:
        folder.rename(sequence)
    except OSError:
        if not sequence.is_dir():
            raise
        shutil.rmtree(folder)


def _version() -> str:
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for path in [*sorted(here.glob("*.py")), *sorted((here.parent / "assets").iterdir())]:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]
