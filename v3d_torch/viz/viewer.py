"""What looks on while a run goes: nothing by default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from v3d_torch.types import RGBDFrame

if TYPE_CHECKING:
    from v3d_torch.objects.dynamics import Scene
    from v3d_torch.slam import V3DSLAM


class Viewer(Protocol):
    """Is shown every frame of a run, and changes nothing."""

    def show(self, frame: RGBDFrame, scene: Scene, slam: V3DSLAM, seconds: Mapping[str, float]) -> None:
        """Show a frame that was taken in.

        Args:
            frame: as the camera gave it.
            scene: what the object stage says of it.
            slam: the system after it; its pose is the last one.
            seconds: that each stage took for it.
        """

    def finish(self, slam: V3DSLAM) -> None:
        """The run is over: show how everything came out, and let go of files and connections."""


class NullViewer:
    """Shows nothing."""

    def show(self, frame: RGBDFrame, scene: Scene, slam: V3DSLAM, seconds: Mapping[str, float]) -> None:
        """Do nothing."""

    def finish(self, slam: V3DSLAM) -> None:
        """Do nothing."""


NULL_VIEWER = NullViewer()
"""The viewer of a run that nobody watches."""
