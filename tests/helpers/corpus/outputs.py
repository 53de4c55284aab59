"""Invalid folders of results, and failures during a run."""

from __future__ import annotations

import os
import resource
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from helpers.corpus.base import STAMPS
from helpers.corpus.case import (
    Case,
    Damage,
    Fails,
    Succeeds,
    Workspace,
    add_options,
    all_of,
    fails_after_run,
    fails_at_frame,
    write,
)
from helpers.privileges import without_root_rights
from v3d_torch.datasets.tum import TUMSequence


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """Limit the size of files, which fails like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def at_frame(index: int, event: Callable[[], object]) -> Iterator[None]:
    """Call a function just before a frame is read."""
    read = TUMSequence.__getitem__

    def reading(self: TUMSequence, i: int) -> object:
        if i == index:
            event()
        return read(self, i)

    with patch.object(TUMSequence, "__getitem__", reading):
        yield


@contextmanager
def full_from_frame(index: int) -> Iterator[None]:
    """Make the disk full just before a frame is read."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with no_file_larger_than(soft), at_frame(index, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20, hard))):
        yield


def raise_bug() -> None:
    """Raise an unexpected exception."""
    raise ZeroDivisionError("an error of the program")


def out_is_a_file(place: Workspace) -> None:
    place.out.write_text("")


def out_below_a_file(place: Workspace) -> None:
    (place.root / "file").write_text("")
    place.options += ["--out", str(place.root / "file" / "out")]


def make_read_only(path_of: Callable[[Workspace], Path]) -> Damage:
    """Make a folder that cannot be written."""

    def make(place: Workspace) -> None:
        path = path_of(place)
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o500)

    return make


def results_of_an_earlier_run(place: Workspace) -> None:
    """Write results with masks of other timestamps, and a file of the user."""
    (place.out / "masks").mkdir(parents=True)
    for name in ("trajectory.txt", "run.log", "masks/1.000000.png", "notes.txt"):
        (place.out / name).write_text("of an earlier run")


def use_sequence_folder(place: Workspace) -> None:
    place.options += ["--out", str(place.folder)]


def make_unreadable(file: str) -> Damage:
    def make(place: Workspace) -> None:
        (place.folder / file).chmod(0)

    return make


SAVE = add_options("--save-masks")
SERIAL = add_options("--serial")
"""Each frame is read after the previous one is complete, so that events occur at the same place in every run."""

CASES = [
    Case(
        "file instead of a folder",
        out_is_a_file,
        Fails("{out}: cannot be made (File exists); choose another folder with --out"),
    ),
    Case(
        "folder below a file",
        out_below_a_file,
        Fails("{root}/file/out: cannot be made (Not a directory); choose another folder with --out"),
    ),
    Case(
        "symlink loop",
        lambda place: place.out.symlink_to(place.out),
        Fails("{out}: cannot be made (File exists); choose another folder with --out"),
    ),
    Case(
        "name with 5000 letters",
        add_options("--out", "{root}/" + 5000 * "x"),
        Fails("{root}/...: cannot be made (File name too long); choose another folder with --out"),
    ),
    Case(
        "folder of the sequence",
        use_sequence_folder,
        Fails("{seq}: is the folder of the sequence; choose another folder with --out"),
    ),
    Case(
        "folder with a foreign map",
        write("../out/map.ply", "of another program"),
        Fails("{out}/map.ply: exists and was not written by a run; choose another folder with --out"),
    ),
    Case("folder with unrelated files", write("../out/thesis.tex", ""), Succeeds()),
    Case(
        "id images in the folder of the saved masks",
        all_of(write("../out/masks/1.0.png", ""), add_options("--segmenter", "masks", "--masks", "{out}/masks")),
        Fails("{out}/masks: would be written while it is read; choose another folder with --out"),
    ),
    Case("empty folder", lambda place: place.out.mkdir(), Succeeds()),
    Case(
        "results of an earlier run",
        all_of(results_of_an_earlier_run, SAVE),
        Succeeds(note="the results of an earlier run are replaced"),
    ),
    Case(
        "read-only folder",
        make_read_only(lambda place: place.out),
        Fails("{out}: cannot be written (Permission denied); choose another folder with --out"),
        lambda place: without_root_rights(),
    ),
    Case(
        "folder in a read-only folder",
        all_of(make_read_only(lambda place: place.root / "closed"), add_options("--out", "{root}/closed/out")),
        Fails("{root}/closed/out: cannot be made (Permission denied); choose another folder with --out"),
        lambda place: without_root_rights(),
    ),
    Case(
        "disk full at the start",
        lambda place: None,
        Fails("{out}/config.yaml: cannot be written (File too large); free the disk or choose another folder"),
        lambda place: no_file_larger_than(0),
    ),
    Case(
        "disk full during the run",
        lambda place: None,
        Fails("{out}/...: cannot be written (File too large); free the disk or choose another folder", saved_poses=8),
        lambda place: no_file_larger_than(9000),
    ),
    Case(
        "disk full while masks are saved",
        all_of(SAVE, SERIAL),
        Fails(
            "{out}/masks/...: cannot be written (File too large); free the disk or choose another folder;"
            " {out}/trajectory.txt: cannot be written (File too large); free the disk or choose another folder"
        ),
        lambda place: full_from_frame(3),
    ),
    Case(
        "folder removed during the run",
        all_of(SAVE, SERIAL),
        Succeeds(note="was removed during the run"),
        lambda place: at_frame(4, lambda: shutil.rmtree(place.out)),
    ),
    Case(
        "folder replaced by a file during the run",
        all_of(SAVE, SERIAL),
        Fails(
            "{out}/masks/...: cannot be written (Not a directory); free the disk or choose another folder;"
            " {out}/request.yaml: cannot be written (File exists); free the disk or choose another folder"
        ),
        lambda place: at_frame(4, lambda: (shutil.rmtree(place.out), place.out.write_text(""))),
    ),
    Case(
        "sequence removed during the run",
        lambda place: None,
        fails_at_frame(
            4, "{seq}/rgb/1305031102.400000.png: is listed but does not exist; copy the whole sequence again"
        ),
        lambda place: at_frame(4, lambda: shutil.rmtree(place.folder)),
    ),
    Case(
        "bug in the program at a frame",
        lambda place: None,
        fails_at_frame(
            4, "the program failed with ZeroDivisionError: an error of the program; report it with the run.log"
        ),
        lambda place: at_frame(4, raise_bug),
    ),
    Case(
        "Ctrl-C",
        SERIAL,
        fails_at_frame(5, "interrupted after 5 of 8 frames"),
        lambda place: at_frame(4, lambda: os.kill(os.getpid(), signal.SIGINT)),
    ),
    Case(
        "list without read permission",
        make_unreadable("rgb.txt"),
        Fails("{seq}/rgb.txt: cannot be read (Permission denied); check that it is a file, and its permissions"),
        lambda place: without_root_rights(),
    ),
    Case(
        "image without read permission",
        make_unreadable(f"rgb/{STAMPS[4]}.png"),
        fails_at_frame(4, "{seq}/rgb/1305031102.400000.png: cannot be read (Permission denied); check its permissions"),
        lambda place: without_root_rights(),
    ),
    Case(
        "image folder without read permission",
        make_unreadable("rgb"),
        Fails("{seq}/rgb/1305031102.000000.png: cannot be read (Permission denied); check its name and permissions"),
        lambda place: without_root_rights(),
    ),
    Case(
        "sequence without read permission",
        make_unreadable("."),
        Fails("{seq}/metadata.yaml: cannot be read (Permission denied); check its name and permissions"),
        lambda place: without_root_rights(),
    ),
    Case(
        "camera without read permission",
        make_unreadable("camera.yaml"),
        Fails("{seq}/camera.yaml: cannot be read (Permission denied); check that it is a file, and its permissions"),
        lambda place: without_root_rights(),
    ),
    Case(
        "ground truth without read permission",
        make_unreadable("groundtruth.txt"),
        fails_after_run(
            "{seq}/groundtruth.txt: cannot be read (Permission denied); check that it is a file, and its permissions"
        ),
        lambda place: without_root_rights(),
    ),
    Case(
        "damaged true mask",
        write(f"masks/{STAMPS[3]}.png", b"\x89PNG\r\n\x1a\n"),
        fails_after_run("{seq}/masks/1305031102.300000.png: is not a PNG, JPEG or TIFF image; copy or export it again"),
    ),
]
