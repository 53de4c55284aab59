"""Invalid values of ``--seq``."""

from __future__ import annotations

from helpers.corpus.case import Case, Damage, Fails, Succeeds, Workspace, add_options, all_of, rename, set_sequence
from helpers.corpus.recordings import noise


def folder(name: str | bytes, *files: str) -> Damage:
    """Create a folder with these text files and use it as the sequence."""

    def make(place: Workspace) -> None:
        path = place.root / name
        path.mkdir()
        for file in files:
            (path / file).write_text("text")
        place.seq = str(path)

    return make


def loop(place: Workspace) -> None:
    """Create a symlink to itself."""
    (place.root / "loop").symlink_to("loop")


CASES = [
    Case("folder name with a line break", rename("two\nlines"), Succeeds()),
    Case("folder name with markup of rich and matplotlib", rename("[red] $x^{$"), Succeeds()),
    Case("folder name in other scripts", rename("部屋 комната 😀 हिन्दी"), Succeeds()),
    Case("folder name that is not UTF-8", rename("caf\udce9"), Succeeds()),
    Case("empty name", set_sequence(""), Fails("the sequence name is empty; pass a name, a folder or a file")),
    Case(
        "empty folder",
        folder("none"),
        Fails(
            "{root}/none: is not a sequence of a supported format; the README lists the formats, of which the simplest"
            " is a folder with colour images in a subfolder rgb and depth images in a subfolder depth"
        ),
    ),
    Case(
        "folder of text files",
        folder("none", "a.txt", "b.txt"),
        Fails(
            "{root}/none: is not a sequence of a supported format; the README lists the formats, of which the simplest"
            " is a folder with colour images in a subfolder rgb and depth images in a subfolder depth"
        ),
    ),
    Case(
        "text file",
        set_sequence("{seq}/rgb.txt"),
        Fails(
            "{seq}/rgb.txt: is not a sequence of a supported format; the README lists the formats, of which the"
            " simplest is a folder with colour images in a subfolder rgb and depth images in a subfolder depth"
        ),
    ),
    Case(
        "image",
        set_sequence("{seq}/rgb/1305031102.000000.png"),
        Fails(
            "{seq}/rgb/1305031102.000000.png: is not a sequence of a supported format; the README lists the"
            " formats, of which the simplest is a folder with colour images in a subfolder rgb and depth images in"
            " a subfolder depth"
        ),
    ),
    Case(
        "archive",
        noise("rgbd_dataset_freiburg3_walking_xyz.tgz"),
        Fails("{root}/rgbd_dataset_freiburg3_walking_xyz.tgz: is an archive; unpack it and pass the folder"),
    ),
    Case(
        "ScanNet recording",
        noise("scene0000_00.sens"),
        Fails(
            "{root}/scene0000_00.sens: is a ScanNet recording; export it with ScanNet's SensReader and pass the"
            " exported folder"
        ),
    ),
    Case(
        "symlink loop",
        all_of(loop, set_sequence("{root}/loop")),
        Fails("{root}/loop: is not a file, a folder or the name of a sequence; did you mean demo or fr3/w/xyz?"),
    ),
    Case(
        "misspelled name",
        set_sequence("fr3/w/xzy"),
        Fails(
            "fr3/w/xzy: is not a file, a folder or the name of a sequence; did you mean fr3/w/xyz or fr3/w/rpy"
            " or fr3/s/xyz?"
        ),
    ),
    Case(
        "missing path",
        set_sequence("{root}/none"),
        Fails("{root}/none: is not a file, a folder or the name of a sequence; did you mean demo or fr3/w/xyz?"),
    ),
    Case(
        "path with 5000 letters",
        set_sequence(5000 * "x"),
        Fails("...: cannot be read (File name too long); check its name and permissions"),
    ),
    Case(
        "home folder of an unknown user",
        set_sequence("~nobody-of-this-name/take"),
        Fails(
            "~nobody-of-this-name/take: is not a file, a folder or the name of a sequence; did you mean demo or"
            " fr3/w/xyz?"
        ),
    ),
    Case("camera that is not connected", set_sequence("realsense:"), Fails("realsense: ...")),
    Case(
        "--rgb-topic for a folder",
        add_options("--rgb-topic", "/rgb"),
        Fails("{seq}: is a folder in TUM layout, which does not support --rgb-topic; remove this option"),
    ),
    Case(
        "--fps for a folder with lists",
        add_options("--fps", "30"),
        Fails("{seq}: is a folder in TUM layout, which does not support --fps; remove this option"),
    ),
]
