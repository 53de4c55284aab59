"""Cases with map files: intact, damaged and incompatible maps, and paths to which a map cannot be saved."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from helpers.corpus.base import HEIGHT, NOISE, STAMPS, WIDTH, png, write_base
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    Workspace,
    add_options,
    all_of,
    edit,
    fails_after_run,
    first_half,
    replace_text,
    write,
)
from v3d_torch.cli import run

NOT_A_MAP = "{seq}/room.map: is not a map file or is damaged (...); give a file written by --save-map"


@cache
def map_bytes() -> bytes:
    """Content of the map file that a run over the sequence saves."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_base(folder / "seq")
        paths = {"--seq": folder / "seq", "--out": folder / "out", "--save-map": folder / "room.map"}
        arguments = [word for option, path in paths.items() for word in (option, str(path))]
        result = CliRunner().invoke(run.app, [*arguments, "--segmenter", "none"])
        assert result.exit_code == 0, result.stderr
        return (folder / "room.map").read_bytes()


def load_map(change: Callable[[bytes], bytes] = lambda content: content) -> Damage:
    """Load a map file with changed content."""

    def make(place: Workspace) -> None:
        write("room.map", change(map_bytes()))(place)
        add_options("--load-map", "{seq}/room.map")(place)

    return make


def with_array(name: str, array: np.ndarray, claim: int | None = None) -> Callable[[bytes], bytes]:
    """Replace an array of the file; ``claim`` is a false unpacked size for its zip entry, bytes."""

    def change(content: bytes) -> bytes:
        changed, file = io.BytesIO(), io.BytesIO()
        np.save(file, array, allow_pickle=True)
        with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(changed, "w") as new:
            for member in old.namelist():
                new.writestr(member, file.getvalue() if member == f"{name}.npy" else old.read(member))
            if claim is not None:
                new.getinfo(f"{name}.npy").file_size = claim
        return changed.getvalue()

    return change


def show_another_room(place: Workspace) -> None:
    """Replace the images by images without any feature of the map."""
    for i, stamp in enumerate(STAMPS):
        noise = np.random.default_rng(50).integers(0, 256, (HEIGHT, WIDTH + 40, 3), dtype=np.uint8)
        (place.folder / "rgb" / f"{stamp}.png").write_bytes(png(noise[:, 2 * i : 2 * i + WIDTH]))


def save_map(path: str) -> Damage:
    """Save the map of the run at a path."""
    return add_options("--save-map", path)


CASES = [
    Case("an intact map", load_map(), Succeeds()),
    Case("localisation in an intact map", all_of(load_map(), add_options("--localise")), Succeeds()),
    Case(
        "--localise without a map",
        add_options("--localise"),
        Fails("--localise: needs the map of an earlier run; add --load-map FILE"),
    ),
    Case(
        "a missing file",
        add_options("--load-map", "{seq}/room.map"),
        Fails("{seq}/room.map: cannot be read (No such file or directory); give a file written by --save-map"),
    ),
    Case(
        "a folder instead of a file",
        add_options("--load-map", "{seq}"),
        Fails("{seq}: cannot be read (Is a directory); give a file written by --save-map"),
    ),
    Case("an empty file", load_map(lambda content: b""), Fails(NOT_A_MAP)),
    Case("random bytes", load_map(lambda content: NOISE), Fails(NOT_A_MAP)),
    Case("an image", load_map(lambda content: png(np.zeros((3, 3), np.uint8))), Fails(NOT_A_MAP)),
    Case("a truncated file", load_map(first_half), Fails(NOT_A_MAP)),
    Case("two wrong bytes", load_map(lambda content: content[:20_000] + b"\0\0" + content[20_002:]), Fails(NOT_A_MAP)),
    Case("a zip archive without a header", load_map(with_array("about", np.zeros(3, np.uint8))), Fails(NOT_A_MAP)),
    Case("pickled objects", load_map(with_array("keyframe/stamp", np.array([{}, {}]))), Fails(NOT_A_MAP)),
    Case(
        "landmark positions that are NaN",
        load_map(with_array("landmark/point", np.full((644, 3), np.nan))),
        Fails(
            "{seq}/room.map: is a damaged map file (landmark/point is not finite); give a file written by --save-map"
        ),
    ),
    Case(
        "missing landmarks",
        load_map(with_array("landmark/point", np.zeros((3, 3)))),
        Fails("{seq}/room.map: is a damaged map file (...); give a file written by --save-map"),
    ),
    Case(
        "an array that claims to be a terabyte",
        load_map(with_array("view/colour", np.zeros((2, 3), np.uint8), claim=1 << 40)),
        Fails(
            "{seq}/room.map: is not a map file or is damaged (it would unpack to ... bytes from ...); give a file"
            " written by --save-map"
        ),
    ),
    Case(
        "a map of another camera",
        all_of(load_map(), edit("camera.yaml", replace_text("64.0", "66.0"))),
        Fails("{seq}/room.map: was made with another camera (...) than the sequence's (...); give another map, or ..."),
    ),
    Case(
        "a map with other feature settings",
        all_of(load_map(), add_options("--set", "features.levels=5")),
        Fails("{seq}/room.map: was made with features.levels=8, not 5; add --set features.levels=8"),
    ),
    Case(
        "a map of another room",
        all_of(load_map(), show_another_room),
        fails_after_run(
            "{seq}/room.map: no frame of {seq} was localised in this map; pass a map of the same place, check the"
            " depth_scale, or run without --load-map"
        ),
    ),
    Case(
        "a map saved to a folder",
        save_map("{seq}"),
        Fails("{seq}: cannot be written (Is a directory); choose another file"),
    ),
    Case(
        "a map saved below a file",
        save_map("{seq}/rgb.txt/room.map"),
        Fails("{seq}/rgb.txt/room.map: cannot be written (File exists); choose another file"),
    ),
    Case(
        "a map saved under a name of 5000 letters",
        save_map("{root}/" + 5000 * "x"),
        Fails("{root}/...: cannot be written (File name too long); choose another file"),
    ),
]
