"""Sources of RGB-D frames; `load_sequence` opens any of them by name."""

from __future__ import annotations

from pathlib import Path

from v3d_torch.camera import PinholeCamera
from v3d_torch.datasets.base import RGBDSequence
from v3d_torch.datasets.cameras import load_camera
from v3d_torch.datasets.locate import sequence_folder
from v3d_torch.datasets.names import PAPER_SEQUENCES, canonical_name, short_name
from v3d_torch.datasets.tum import TUMSequence
from v3d_torch.download import Progress, cache_dir

__all__ = [
    "PAPER_SEQUENCES",
    "RGBDSequence",
    "TUMSequence",
    "canonical_name",
    "load_camera",
    "load_sequence",
    "short_name",
]


def load_sequence(
    name: str,
    *,
    data_root: Path | None = None,
    camera: str | Path | PinholeCamera | None = None,
    download: bool = True,
    progress: Progress | None = None,
) -> RGBDSequence:
    """Open a sequence.

    Args:
        name: ``demo``; a folder in TUM layout; a name such as ``fr3/w/xyz`` (`canonical_name` lists the ways to write
            it); or the name of a folder in ``data_root``.
        data_root: where sequences are kept; None takes ``$V3D_DATA``, then the cache (``$V3D_CACHE``).
        camera: a camera, a preset's name or a camera file; None takes the sequence's own.
        download: whether a TUM sequence that is not here is downloaded.
        progress: told of the bytes of a download, or of the frames of the demo as they are made.

    Raises:
        InputError: there is no such sequence, or something in it is wrong.
        DownloadError: it is not here and cannot be downloaded.
    """
    if name == "demo":
        # The demo is rendered on first use, with libraries that nothing else here needs.
        from v3d_torch.datasets.demo import ensure_demo

        return TUMSequence(ensure_demo(cache_dir(), progress), camera, name="demo")
    folder = sequence_folder(name, data_root=data_root, download=download, progress=progress)
    return TUMSequence(folder, camera)
