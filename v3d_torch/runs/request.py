"""Request of a run: all options given by the user, in one value."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from v3d_torch.config import Config
from v3d_torch.config.validation import first_error
from v3d_torch.datasets import RGBDSequence, RGBDStream, SourceOptions, load_sequence, open_source
from v3d_torch.datasets.cameras import PRESETS
from v3d_torch.datasets.locate import data_root_of
from v3d_torch.datasets.sequence_names import BUILT_IN_SEQUENCES
from v3d_torch.errors import InputError
from v3d_torch.io.download import Progress
from v3d_torch.io.files import write_text
from v3d_torch.io.paths import expand_user
from v3d_torch.io.safe_yaml import parse_yaml
from v3d_torch.io.text_file import read_text
from v3d_torch.runs.file_names import RunFile

CHANGEABLE = ("seq", "data_root", "skip_broken")
"""Names of the options that can change when a run is resumed."""

_PATHS = ("data_root", "masks", "weights", "load_map", "save_map")


@dataclass(frozen=True)
class RunRequest:
    """Inputs, outputs and configuration of one run. Checkpoints store it, so that the run can be resumed.

    Attributes:
        seq: Name of the source, see `open_source`.
        config: Configuration of the system.
        data_root: Folder of named sequences; None for the search order of `open_source`.
        camera: Camera file or preset; None for the camera of the sequence.
        rgb_topic: Topic of the colour images of a bag; None for automatic selection.
        depth_topic: Topic of the depth images of a bag; None for automatic selection.
        info_topic: Topic of the camera info of a bag; None for automatic selection.
        fps: Frame rate, Hz, see `SourceOptions`; None for the timestamps of the source.
        masks: Folder of id images, if instances are read from files; None otherwise.
        weights: Weights file of the network; None for the published weights.
        load_map: Map file in which the camera is localised; None to start a new map.
        save_map: File to which the map is saved at the end; None to save no map.
        save_masks: True to write an image of the masked pixels for each frame.
        realtime: True to play the sequence at its own rate, like a live camera.
        skip_broken: True to skip broken frames, see `v3d_torch.datasets.readable_frames.ReadableFrames`.
    """

    seq: str
    config: Config
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
    realtime: bool = False
    skip_broken: bool = False

    @staticmethod
    def of_sequence(
        seq: str,
        data_root: Path | None,
        *,
        camera: str | None = None,
        fps: float | None = None,
        skip_broken: bool = False,
    ) -> RunRequest:
        """Make the request for a sequence of several configurations; ``config`` is replaced in each run."""
        root = None if data_root is None else str(data_root)
        return RunRequest(seq, Config(), data_root=root, camera=camera, fps=fps, skip_broken=skip_broken)

    def open_source(self, progress: Progress | None = None) -> RGBDStream:
        """Open the source of frames, see `v3d_torch.datasets.open_source`."""
        return open_source(self.seq, progress=progress, **self._source_options())

    def load_sequence(self, progress: Progress | None = None) -> RGBDSequence:
        """Open the source of frames, which must be a stored sequence, see `v3d_torch.datasets.load_sequence`."""
        return load_sequence(self.seq, progress=progress, **self._source_options())

    def _source_options(self) -> dict[str, Any]:
        """Return the arguments of `open_source` and `load_sequence` but the name."""
        return {
            "data_root": self.data_root,
            "camera": self.camera,
            "options": SourceOptions(self.rgb_topic, self.depth_topic, self.info_topic, self.fps),
            "skip_broken": self.skip_broken,
        }

    def absolute(self) -> RunRequest:
        """Return the same request with absolute paths, independent of the working directory and of ``$V3D_DATA``."""
        values = self._options()
        for name in _PATHS:
            if values[name] is not None:
                values[name] = str(expand_user(values[name]).absolute())
        if values["data_root"] is None and (root := data_root_of(self.seq, None)) is not None:
            values["data_root"] = str(root)
        for name, not_a_path in (("seq", BUILT_IN_SEQUENCES), ("camera", (None, *PRESETS))):
            if values[name] not in not_a_path:
                values[name] = _absolute_if_exists(values[name])
        return RunRequest(config=self.config, **values)

    def conflicting_option(self, other: RunRequest) -> str | None:
        """Return the first option that another request sets to a different value, as it is typed; None if none.

        Options with the location of the sequence do not conflict, because the sequence may have been moved, and neither
        does ``skip_broken``, because a broken frame may have ended the run.
        """
        options = self._options()
        for name, value in other.absolute()._options().items():
            if name not in CHANGEABLE and value is not None and value is not False and value != options[name]:
                return f"--{name.replace('_', '-')}"
        return None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, which `from_dict` reads."""
        return {**self._options(), "config": self.config.model_dump(mode="json")}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> RunRequest:
        """Make a request from the values of `to_dict`.

        Raises:
            ValueError: If a value of the configuration is not valid.
            KeyError: If the configuration is missing.
            TypeError: If another key is missing or unknown.
        """
        return RunRequest(**{**values, "config": Config.model_validate(values["config"])})

    def _options(self) -> dict[str, Any]:
        """Return everything but the configuration."""
        return {name: value for name, value in vars(self).items() if name != "config"}


def write_request(folder: Path, request: RunRequest) -> None:
    """Write the options of a run, with absolute paths and without the configuration, to ``request.yaml``.

    Args:
        folder: Folder of the results.
        request: Request of the run.

    Raises:
        OutputError: If the file cannot be written.
    """
    write_text(folder / RunFile.REQUEST, yaml.safe_dump(request.absolute()._options(), sort_keys=False))


def read_request(folder: Path) -> RunRequest:
    """Read the options of a run, with the default configuration.

    Args:
        folder: Folder of the results.

    Raises:
        InputError: If the file is missing or damaged.
    """
    path = folder / RunFile.REQUEST
    text = read_text(path, "it is written by a run")
    try:
        options = parse_yaml(text)
        if not isinstance(options, dict):
            raise ValueError("it is not a mapping")
        request = TypeAdapter(RunRequest).validate_python({**options, "config": Config()})
        if missing := set(RunRequest.__dataclass_fields__) - {"config"} - set(options):
            raise ValueError(f"it lacks {min(missing)}")
        return request
    except ValidationError as error:
        raise InputError(f"{path}: {first_error(error)}; run the sequence again") from error
    except ValueError as error:
        raise InputError(f"{path}: is not the request of a run ({error}); run the sequence again") from error


def check_not_moved(request: RunRequest, folder: Path) -> None:
    """Check that the sequence of an earlier run is still at its place.

    Args:
        request: Request that the run stored.
        folder: Folder of the results of the run.

    Raises:
        InputError: If the request has a path that no longer exists.
    """
    if Path(request.seq).is_absolute() and not os.path.lexists(request.seq):
        raise InputError(
            f"{request.seq}: the sequence of the run in {folder} is not there; give its new place with --seq"
        )


def _absolute_if_exists(name: str) -> str:
    """Return the absolute path if the name is that of an existing file or folder, else the name."""
    with suppress(OSError):  # names can be too long for a path
        if (path := expand_user(name)).exists():
            return str(path.absolute())
    return name
