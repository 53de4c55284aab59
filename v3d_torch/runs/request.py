"""What a user asks of a run, beside its configuration and the folder of its results."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass

from v3d_torch.datasets import SourceOptions
from v3d_torch.datasets.cameras import PRESETS
from v3d_torch.io.paths import expand_user


@dataclass(frozen=True)
class RunRequest:
    """What a run takes in and gives out. It goes into checkpoints, so that the run can be gone on with.

    Attributes:
        seq: as `open_source` takes it.
        data_root: where named sequences are; None takes the usual places.
        camera: file or preset; None takes the sequence's own.
        rgb_topic: see `SourceOptions`, as the next three.
        depth_topic: of a bag.
        info_topic: of a bag.
        fps: of images and videos.
        masks: folder of id images; None where nothing is read there.
        weights: of the network; None takes the usual ones.
        map_in: map to find the camera in; None begins a new one.
        map_out: where the map goes in the end; None for nowhere.
        save_masks: whether what is left out of tracking is written.
    """

    seq: str
    data_root: str | None = None
    camera: str | None = None
    rgb_topic: str | None = None
    depth_topic: str | None = None
    info_topic: str | None = None
    fps: float | None = None
    masks: str | None = None
    weights: str | None = None
    load_map: str | None = None
    save_map: str | None = None
    save_masks: bool = False

    @property
    def options(self) -> SourceOptions:
        """What the source does not say itself."""
        return SourceOptions(self.rgb_topic, self.depth_topic, self.info_topic, self.fps)

    def absolute(self) -> RunRequest:
        """The same, meaning the same in every working directory."""
        values = asdict(self)
        for name in _PATHS:
            if values[name] is not None:
                values[name] = str(expand_user(values[name]).absolute())
        for name, no_path in (("seq", ("demo",)), ("camera", (None, *PRESETS))):
            if values[name] not in no_path:
                values[name] = _path_if_there(values[name])
        return RunRequest(**values)

    def conflicting_option(self, given: RunRequest) -> str | None:
        """The first option, but for those that say where sequences are, that another request gives and this one not."""
        for name, value in asdict(given.absolute()).items():
            if name not in ("seq", "data_root") and value not in (None, False) and value != getattr(self, name):
                return _OPTIONS.get(name, f"--{name.replace('_', '-')}")
        return None


_PATHS = ("data_root", "masks", "weights", "map_in", "map_out")

_OPTIONS = {"map_in": "--load-map", "map_out": "--save-map"}
"""Those that are called otherwise on the command line."""


def _path_if_there(name: str) -> str:
    """A name that may be a path: absolute where it is one."""
    with suppress(OSError):  # a name that is too long
        if (path := expand_user(name)).exists():
            return str(path.absolute())
    return name
