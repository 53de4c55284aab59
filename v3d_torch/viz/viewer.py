"""Creation of the viewer of a run from the options of the command line."""

from __future__ import annotations

from pathlib import Path

from v3d_torch.datasets.base import RGBDStream
from v3d_torch.errors import ConfigError, ViewerError
from v3d_torch.pipeline import Viewer


def make_viewer(viz: str | None, rerun_file: Path | None, sequence: RGBDStream) -> Viewer | None:
    """Create the viewer of a run; None if no option asks for one.

    Args:
        viz: ``rerun`` to show the run while it is processed; None for no window.
        rerun_file: Rerun recording to write, ``.rrd``, which must not exist; None for no recording.
        sequence: Sequence to process.

    Raises:
        ConfigError: If the viewer is unknown.
        ViewerError: If the viewer's library is not installed, or the viewer cannot be started.
        OutputError: If the recording exists, has another suffix or cannot be written.
    """
    if viz not in (None, "rerun"):
        raise ConfigError(f"--viz {viz}: unknown viewer; use --viz rerun")
    if viz is None and rerun_file is None:
        return None
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        option = "--viz rerun" if viz is not None else "--rerun"
        raise ViewerError(f"{option}: needs rerun-sdk ({error}); run pip install 'v3d-torch[rerun]'") from error
    from v3d_torch.viz.rerun.stream import open_stream
    from v3d_torch.viz.rerun.viewer import RerunViewer

    stream = open_stream(live=viz is not None, file=rerun_file)
    return RerunViewer(stream, sequence.camera, sequence.groundtruth, sequence.name)
