"""Built-in sequences: a hand-held camera in a furnished room with people who move, rendered on first use."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from pathlib import Path

from v3d_torch.datasets.demo.sequence import Progress, write_sequence
from v3d_torch.errors import OutputError


def ensure_demo(cache_dir: Path, progress: Progress | None = None, name: str = "demo") -> Path:
    """Return the folder of a built-in sequence, rendering it if it is not in the cache.

    The name of the folder contains a hash of the code and the photographs from which it is rendered, so that images of
    another version are never used.

    Args:
        cache_dir: Folder for the sequence; created if missing.
        progress: Called with (frames done, number of frames) while the sequence is rendered.
        name: Name of the sequence, a key of `v3d_torch.datasets.demo.scenes.SCENES`.

    Returns:
        Folder in TUM layout: ``rgb/*.jpg``, ``depth/*.png`` (16 bit, 5000 units per metre, 0 = no measurement),
        ``rgb.txt``, ``depth.txt``, ``associations.txt``, ``groundtruth.txt`` (camera-to-world), ``camera.yaml``, and
        ``masks/*.png`` with the true motion mask (0 = static, else the id of the person or thing that moves there; the
        still parts of a body are static), ``instances/*.png`` with the ids of all people and things, moving or not,
        and ``instances/labels.yaml`` with the classes of those that a network can name.

    Raises:
        OutputError: If the folder cannot be written.
    """
    sequence = cache_dir / f"{name.replace(':', '-')}-{_version()}"
    if sequence.is_dir():
        return sequence
    try:
        cache_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".demo-", dir=cache_dir) as temporary:
            folder = Path(temporary) / "sequence"
            write_sequence(folder, progress=progress, name=name)
            _publish(folder, sequence)
    except OSError as error:
        raise OutputError(
            f"{cache_dir}: cannot store {name} ({error.strerror or error}); set V3D_CACHE to another folder, or"
            " free the disk if it is full"
        ) from error
    return sequence


def _publish(folder: Path, sequence: Path) -> None:
    """Rename the rendered folder; if another process was faster, keep its sequence, which has the same bytes."""
    try:
        folder.rename(sequence)
    except OSError:
        if not sequence.is_dir():
            raise
        shutil.rmtree(folder)


def _version() -> str:
    """Hash of the code and the photographs of the sequences."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for path in [*sorted(here.rglob("*.py")), *sorted((here.parent / "assets").iterdir())]:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]
