"""Maps of earlier runs, and where the next one is to be saved."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from helpers.corpus.base import NOISE, STAMPS, png, write_base
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    Workspace,
    add_options,
    all_of,
    edit,
    first_half,
    replace_text,
    write,
)
from v3d_torch.cli import run

NO_MAP = "{seq}/room.map: is no map, or a damaged one (...); give a file that --save-map wrote"


@cache
def whole() -> bytes:
    """A map of the sequence."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_base(folder / "seq")
        paths = {"--seq": folder / "seq", "--out": folder / "out", "--save-map": folder / "room.map"}
        given = [word for option, path in paths.items() for word in (option, str(path))]
        done = CliRunner().invoke(run.app, [*given, "--segmenter", "none"])
        assert done.exit_code == 0, done.stderr
        return (folder / "room.map").read_bytes()


def given(change: Callable[[bytes], bytes] = lambda content: content) -> Damage:
    """The map, changed."""

    def make(place: Workspace) -> None:
        write("room.map", change(whole()))(place)
        add_options("--load-map", "{seq}/room.map")(place)

    return make


def with_array(name: str, array: np.ndarray, claim: int | None = None) -> Callable[[bytes], bytes]:
    """Another array in place of one of the map, which may claim to be larger than it is."""

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


def of_another_room(place: Workspace) -> None:
    """Other images, in which nothing is of the map."""
    for i, stamp in enumerate(STAMPS):
        noise = np.random.default_rng(50).integers(0, 256, (60, 120, 3), dtype=np.uint8)
        (place.folder / "rgb" / f"{stamp}.png").write_bytes(png(noise[:, 2 * i : 2 * i + 80]))


def saved(to: str) -> Damage:
    return add_options("--save-map", to)


CASES = [
    Case("a map", given(), Succeeds()),
    Case("a map to find the camera in", all_of(given(), add_options("--localise")), Succeeds()),
    Case(
        "--localise without a map",
        add_options("--localise"),
        Fails("mapping.enabled=false: there is no map to find the camera in; give one with --load-map"),
    ),
    Case(
        "not there",
        add_options("--load-map", "{seq}/room.map"),
        Fails("{seq}/room.map: cannot be read (No such file or directory); give a file that --save-map wrote"),
    ),
    Case(
        "a folder",
        add_options("--load-map", "{seq}"),
        Fails("{seq}: cannot be read (Is a directory); give a file that --save-map wrote"),
    ),
    Case("empty", given(lambda content: b""), Fails(NO_MAP)),
    Case("noise", given(lambda content: NOISE), Fails(NO_MAP)),
    Case("an image", given(lambda content: png(np.zeros((3, 3), np.uint8))), Fails(NO_MAP)),
    Case("breaks off", given(first_half), Fails(NO_MAP)),
    Case("a wrong byte", given(lambda content: content[:20_000] + b"\0\0" + content[20_002:]), Fails(NO_MAP)),
    Case("a zip of something else", given(with_array("about", np.zeros(3, np.uint8))), Fails(NO_MAP)),
    Case("objects in place of numbers", given(with_array("keyframe/stamp", np.array([{}, {}]))), Fails(NO_MAP)),
    Case(
        "a position that is no number",
        given(with_array("landmark/point", np.full((644, 3), np.nan))),
        Fails("{seq}/room.map: is a damaged map (landmark/point is not finite); give a file that --save-map wrote"),
    ),
    Case(
        "landmarks that are missing",
        given(with_array("landmark/point", np.zeros((3, 3)))),
        Fails("{seq}/room.map: is a damaged map (...); give a file that --save-map wrote"),
    ),
    Case(
        "an array that claims a terabyte",
        given(with_array("view/colour", np.zeros((2, 3), np.uint8), claim=1 << 40)),
        Fails(
            "{seq}/room.map: is no map, or a damaged one (it claims to hold ... bytes in ...); give a file that"
            " --save-map wrote"
        ),
    ),
    Case(
        "of another camera",
        all_of(given(), edit("camera.yaml", replace_text("64.0", "66.0"))),
        Fails("{seq}/room.map: was made with another camera (...) than the sequence's (...); give another map, or ..."),
    ),
    Case(
        "of other features",
        all_of(given(), add_options("--set", "features.levels=5")),
        Fails("{seq}/room.map: was made with features.levels=8, not 5; add --set features.levels=8"),
    ),
    Case(
        "of another room",
        all_of(given(), of_another_room),
        Fails("{seq}/room.map: no frame of {seq} shows a place of this map; its results are in {out}", saved_poses=8),
    ),
    Case(
        "to be saved as a folder",
        saved("{seq}"),
        Fails("{seq}: cannot be written (Is a directory); give another file"),
    ),
    Case(
        "to be saved below a file",
        saved("{seq}/rgb.txt/room.map"),
        Fails("{seq}/rgb.txt/room.map: cannot be written (File exists); give another file"),
    ),
    Case(
        "to be saved under a name of 5000 letters",
        saved("{root}/" + 5000 * "x"),
        Fails("{root}/...: cannot be written (File name too long); give another file"),
    ),
]
