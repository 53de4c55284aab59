"""Checks of the path to which a run saves its map, so that the map replaces no file of the user and no result."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from v3d_torch.errors import InputError, OutputError
from v3d_torch.io.array_file import open_array_file
from v3d_torch.mapping.map_io import MAP_FORMAT
from v3d_torch.runs.file_names import RunFile
from v3d_torch.runs.result_folder import is_result


def is_map_file(path: Path) -> bool:
    """Check whether a path is that of a map file, of any version."""
    try:
        if not path.is_file():  # opening a pipe would wait for its other end
            return False
        with open_array_file(path, MAP_FORMAT, "a map file", "give another file"):
            return True
    except (InputError, OSError):  # OSError: such as of a name that is too long for a path
        return False


def check_map_path(path: Path, folder: Path | None) -> None:
    """Check that a map can be written to a path: nothing is there, or an earlier map, which may be replaced.

    A path that cannot be written, such as a folder or a name that is too long, is not reported here.

    Args:
        path: File to which the map is to be saved.
        folder: Folder of the results of the run; None if it is not known yet.

    Raises:
        OutputError: If the path has the name of a point cloud or of a result in the folder, or is that of a file other
            than a map.
    """
    if path.suffix.lower() == ".ply":
        raise OutputError(
            f"{path}: would contain no point cloud, which is {RunFile.MAP} of the results; choose another file with"
            " --save-map, such as room.npz"
        )
    if folder is not None and is_result(path, folder):
        raise OutputError(f"{path}: is a result of the run; choose another file with --save-map")
    with suppress(OSError):
        if path.exists() and not path.is_dir() and not is_map_file(path):
            raise OutputError(f"{path}: exists and is not a map; move it, or choose another file with --save-map")
