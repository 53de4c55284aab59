"""Invalid values of ``--seq``."""

from __future__ import annotations

from helpers.corpus.case import Case, Make, Place, Right, Says, all_of, options, seq
from helpers.corpus.recordings import noise


def folder(name: str | bytes, *files: str) -> Make:
    """Create a folder with these text files and use it as the sequence."""

    def make(place: Place) -> None:
        path = place.root / name
        path.mkdir()
        for file in files:
            (path / file).write_text("text")
        place.seq = str(path)

    return make


def rename(name: str) -> Make:
    """Rename the sequence's folder."""

    def make(place: Place) -> None:
        place.seq = str(place.folder.rename(place.root / name))

    return make


def loop(place: Place) -> None:
    """Create a symlink to itself."""
    (place.root / "loop").symlink_to("loop")


CASES = [
    Case("folder name with a line break", rename("two\nlines"), Right()),
    Case("folder name with markup of rich and matplotlib", rename("[red] $x^{$"), Right()),
    Case("folder name that is not UTF-8", rename("caf\udce9"), Right()),
    Case("empty name", seq(""), Says("the sequence name is empty; pass a name, a folder or a file")),
    Case(
        "empty folder",
        folder("none"),
        Says(
            "{root}/none: is not a sequence of a supported format; the README lists the formats, the simplest"
            " is a folder with colour images in a subfolder rgb and depth images in a subfolder depth"
        ),
    ),
    Case(
        "folder of text files",
        folder("none", "a.txt", "b.txt"),
        Says(
            "{root}/none: is not a sequence of a supported format; the README lists the formats, the simplest"
            " is a folder with colour images in a subfolder rgb and depth images in a subfolder depth"
        ),
    ),
    Case(
        "text file",
        seq("{seq}/rgb.txt"),
        Says(
            "{seq}/rgb.txt: is not a sequence of a supported format; the README lists the formats, the simplest"
            " is a folder with colour images in a subfolder rgb and depth images in a subfolder depth"
        ),
    ),
    Case(
        "image",
        seq("{seq}/rgb/1305031102.000000.png"),
        Says(
            "{seq}/rgb/1305031102.000000.png: is not a sequence of a supported format; the README lists the"
            " formats, the simplest is a folder with colour images in a subfolder rgb and depth images in a"
            " subfolder depth"
        ),
    ),
    Case(
        "archive",
        noise("rgbd_dataset_freiburg3_walking_xyz.tgz"),
        Says("{root}/rgbd_dataset_freiburg3_walking_xyz.tgz: is an archive; unpack it and pass the folder"),
    ),
    Case(
        "ScanNet recording",
        noise("scene0000_00.sens"),
        Says(
            "{root}/scene0000_00.sens: is a ScanNet recording; export it with ScanNet's SensReader and pass the"
            " exported folder"
        ),
    ),
    Case(
        "symlink loop",
        all_of(loop, seq("{root}/loop")),
        Says("{root}/loop: is not a file, a folder or the name of a sequence; did you mean demo or fr3/w/xyz?"),
    ),
    Case(
        "misspelled name",
        seq("fr3/w/xzy"),
        Says(
            "fr3/w/xzy: is not a file, a folder or the name of a sequence; did you mean fr3/w/xyz or fr3/w/rpy"
            " or fr3/s/xyz?"
        ),
    ),
    Case(
        "missing path",
        seq("{root}/none"),
        Says("{root}/none: is not a file, a folder or the name of a sequence; did you mean demo or fr3/w/xyz?"),
    ),
    Case(
        "path with 5000 letters",
        seq(5000 * "x"),
        Says("...: cannot be read (File name too long); check its name and permissions"),
    ),
    Case(
        "home folder of an unknown user",
        seq("~nobody-of-this-name/take"),
        Says(
            "~nobody-of-this-name/take: is not a file, a folder or the name of a sequence; did you mean demo or"
            " fr3/w/xyz?"
        ),
    ),
    Case("camera that is not connected", seq("realsense:"), Says("realsense: ...")),
    Case(
        "--rgb-topic for a folder",
        options("--rgb-topic", "/rgb"),
        Says("{seq}: is a folder in TUM layout, which does not support --rgb-topic; remove this option"),
    ),
    Case(
        "--fps for a folder with lists",
        options("--fps", "30"),
        Says("{seq}: is a folder in TUM layout, which does not support --fps; remove this option"),
    ),
]
