"""What looks on while a run goes: nothing by default."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from v3d_torch.datasets.base import RGBDStream
from v3d_torch.errors import ConfigError, ViewerError
from v3d_torch.types import RGBDFrame

if TYPE_CHECKING:
    from v3d_torch.objects.frame_objects import FrameObjects
    from v3d_torch.slam import V3DSLAM


class Viewer(Protocol):
    """Is shown every frame of a run, and changes nothing."""

    def show(self, frame: RGBDFrame, scene: FrameObjects, slam: V3DSLAM, seconds: Mapping[str, float]) -> None:
        """Show a frame that was taken in.

        Args:
            frame: as the camera gave it.
            scene: what the object stage says of it.
            slam: the system after it; its pose is the last one.
            seconds: that each stage took for it.
        """

    def finish(self, slam: V3DSLAM) -> None:
        """The run is over: show how everything came out, and let go of files and connections.

        Raises:
            OutputError: what was shown could not be written.
        """


class NullViewer:
    """Shows nothing."""

    def show(self, frame: RGBDFrame, scene: FrameObjects, slam: V3DSLAM, seconds: Mapping[str, float]) -> None:
        """Do nothing."""

    def finish(self, slam: V3DSLAM) -> None:
        """Do nothing."""


NULL_VIEWER = NullViewer()
"""The viewer of a run that nobody watches."""


def make_viewer(viz: str | None, rerun_file: Path | None, sequence: RGBDStream) -> Viewer:
    """Open the viewer for a run.

    Args:
        viz: ``rerun`` to look on while it runs; None for no window.
        rerun_file: to record to for rerun; None for none.
        sequence: that will run.

    Raises:
        ConfigError: there is no viewer of that name.
        ViewerError: its library is not installed, or it cannot be started.
        OutputError: the file cannot be written.
    """
    if viz not in (None, "rerun"):
        raise ConfigError(f"--viz {viz}: there is no such viewer; there is rerun")
    if viz is None and rerun_file is None:
        return NULL_VIEWER
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        option = "--viz rerun" if viz is not None else "--rerun"
        raise ViewerError(f"{option} needs rerun-sdk ({error}); pip install 'v3d-torch[rerun]'") from error
    from v3d_torch.viz.rerun.stream import open_stream
    from v3d_torch.viz.rerun.viewer import RerunViewer

    stream = open_stream(live=viz is not None, file=rerun_file)
    return RerunViewer(stream, sequence.camera, sequence.groundtruth, sequence.name)
