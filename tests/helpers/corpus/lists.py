"""Lists of images."""

from __future__ import annotations

from collections.abc import Callable

from helpers.corpus.base import STAMPS
from helpers.corpus.case import Case, Make, Place, Right, Says, all_of, edit, remove, replaced, write


def stamps_as(
    form: Callable[[float], str], files: tuple[str, ...] = ("rgb.txt", "depth.txt", "groundtruth.txt")
) -> Make:
    """Write the stamps of these files in another way."""

    def make(place: Place) -> None:
        for file in files:
            path = place.folder / file
            lines = [line.split(maxsplit=1) for line in path.read_text().splitlines()]
            path.write_text("".join(f"{form(float(stamp))} {rest}\n" for stamp, rest in lines))

    return make


def renamed(change: Callable[[str, str], str], *, absolute: bool = False) -> Make:
    """Rename the images, by kind and stamp, in the lists too."""

    def make(place: Place) -> None:
        for kind in ("rgb", "depth"):
            lines = []
            for stamp in STAMPS:
                name = change(kind, stamp)
                (place.folder / name).parent.mkdir(parents=True, exist_ok=True)
                (place.folder / kind / f"{stamp}.png").rename(place.folder / name)
                lines.append(f"{stamp} {place.folder / name if absolute else name}\n")
            (place.folder / f"{kind}.txt").write_text("".join(lines))

    return make


def lines(file: str, change: Callable[[list[str]], list[str]]) -> Make:
    """Change the lines of a file."""

    def make(place: Place) -> None:
        path = place.folder / file
        path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))

    return make


def associated(form: str) -> Make:
    """One list instead of two, with lines of a form in which C and D are the images."""

    def make(place: Place) -> None:
        text = "".join(
            form.replace("T", s).replace("C", f"rgb/{s}.png").replace("D", f"depth/{s}.png") + "\n" for s in STAMPS
        )
        (place.folder / "associations.txt").write_text(text)

    return make


def frames(keep: list[int]) -> Make:
    def pick(listed: list[str]) -> list[str]:
        return [listed[i] for i in keep]

    return all_of(lines("rgb.txt", pick), lines("depth.txt", pick))


def loop(file: str) -> Make:
    def make(place: Place) -> None:
        path = place.folder / file
        path.unlink()
        path.symlink_to(path.name)

    return make


def folder_at(file: str) -> Make:
    def make(place: Place) -> None:
        path = place.folder / file
        path.unlink()
        path.mkdir()

    return make


FIRST = f"rgb/{STAMPS[0]}.png"

CASES = [
    Case("Windows line ends", edit("rgb.txt", replaced("\n", "\r\n")), Right()),
    Case("line ends of old Macs", edit("rgb.txt", replaced("\n", "\r")), Right()),
    Case("byte order mark", edit("rgb.txt", lambda content: b"\xef\xbb\xbf" + content), Right()),
    Case(
        "comments and blank lines",
        edit("depth.txt", lambda c: b"# depth maps\n#\n\n" + c.replace(b"\n", b"\n\n# x\n")),
        Right(),
    ),
    Case("tabs", edit("rgb.txt", replaced(" ", "\t")), Right()),
    Case("commas", edit("rgb.txt", replaced(" ", ", ")), Right()),
    Case("spaces in names", renamed(lambda kind, stamp: f"{kind}/my take {stamp}.png"), Right()),
    Case("names that are no ASCII", renamed(lambda kind, stamp: f"bilder für {kind}/{stamp} 深度.png"), Right()),
    Case("absolute paths", renamed(lambda kind, stamp: f"{kind}/{stamp}.png", absolute=True), Right()),
    Case("paths through the parent", edit("rgb.txt", replaced("rgb/", "../seq/rgb/")), Right()),
    Case("a stamp twice", lines("rgb.txt", lambda listed: [*listed, listed[3].split()[0] + f" {FIRST}"]), Right()),
    Case("lines in any order", lines("rgb.txt", lambda listed: [listed[i] for i in (3, 0, 7, 1, 6, 2, 5, 4)]), Right()),
    Case("stamps in nanoseconds", stamps_as(lambda s: f"{s * 1e9:.0f}"), Right()),
    Case("stamps in microseconds", stamps_as(lambda s: f"{s * 1e6:.0f}"), Right()),
    Case("stamps in milliseconds", stamps_as(lambda s: f"{s * 1e3:.0f}"), Right()),
    Case(
        "milliseconds since the start",
        stamps_as(lambda s: f"{(s - 1305031102) * 1e3:.0f}"),
        Says(
            "{seq}: by their stamps its images lie 100 s apart; stamps are seconds, divide them in the"
            " lists if they are milli- or nanoseconds"
        ),
    ),
    Case(
        "nanoseconds since the start",
        stamps_as(lambda s: f"{(s - 1305031102) * 1e9:.0f}"),
        Says(
            "{seq}: by their stamps its images lie 9.99999e+07 s apart; stamps are seconds, divide them in"
            " the lists if they are milli- or nanoseconds"
        ),
    ),
    Case("negative stamps", stamps_as(lambda s: f"{s - 1305031102.35:.6f}"), Right()),
    Case(
        "stamps that are words",
        lines("rgb.txt", lambda listed: [f"frame{i} {line.split()[1]}" for i, line in enumerate(listed)]),
        Says("{seq}/rgb.txt: line 1 has 'frame0' where a stamp in seconds is expected; repair or remove the line"),
    ),
    Case(
        "a stamp that is not a number",
        lines("rgb.txt", lambda listed: [*listed[:3], f"nan {FIRST}", *listed[3:]]),
        Says("{seq}/rgb.txt: line 4 has 'nan' where a stamp in seconds is expected; repair or remove the line"),
    ),
    Case(
        "an infinite stamp",
        lines("depth.txt", lambda listed: [f"inf {FIRST}", *listed]),
        Says("{seq}/depth.txt: line 1 has 'inf' where a stamp in seconds is expected; repair or remove the line"),
    ),
    Case(
        "lists of two clocks",
        stamps_as(lambda s: f"{s + 10:.6f}", ("depth.txt",)),
        Says(
            "{seq}: no stamp in rgb.txt lies within 0.02 s of one in depth.txt; do both lists belong to this sequence?"
        ),
    ),
    Case(
        "empty list",
        write("rgb.txt", ""),
        Says("{seq}/rgb.txt: lists no images; a list has lines of a stamp and a file, copy it again"),
    ),
    Case(
        "list of comments only",
        write("depth.txt", "# depth maps\n"),
        Says("{seq}/depth.txt: lists no images; a list has lines of a stamp and a file, copy it again"),
    ),
    Case(
        "no list of colour",
        remove("rgb.txt"),
        Says("{seq}: has no rgb.txt; the sequence's images are listed in rgb.txt and depth.txt"),
    ),
    Case(
        "no list of depth",
        remove("depth.txt"),
        Says("{seq}: has no depth.txt; the sequence's images are listed in rgb.txt and depth.txt"),
    ),
    Case("no lists at all", remove("rgb.txt", "depth.txt"), Right(ate=None)),
    Case(
        "a listed image is not there",
        remove(FIRST),
        Says("{seq}/rgb/1305031102.000000.png: is listed but not there (1 such files); copy the whole sequence again"),
    ),
    Case(
        "a line breaks off",
        edit("rgb.txt", lambda content: content[:-5]),
        Says("{seq}/rgb/1305031102.700000: is listed but not there (1 such files); copy the whole sequence again"),
    ),
    Case(
        "a line without a name",
        lines("rgb.txt", lambda listed: [*listed[:3], STAMPS[3], *listed[4:]]),
        Says("{seq}/rgb.txt: line 4 is '1305031102.300000' where a stamp and a file are expected; repair or remove it"),
    ),
    Case(
        "a listed image is a folder",
        folder_at(FIRST),
        Says("{seq}/rgb/1305031102.000000.png: is listed but not there (1 such files); copy the whole sequence again"),
    ),
    Case(
        "a listed image is a loop of links",
        loop(FIRST),
        Says("{seq}/rgb/1305031102.000000.png: is listed but not there (1 such files); copy the whole sequence again"),
    ),
    Case(
        "the list is a loop of links",
        loop("rgb.txt"),
        Says("{seq}: has no rgb.txt; the sequence's images are listed in rgb.txt and depth.txt"),
    ),
    Case(
        "the list is a folder",
        folder_at("rgb.txt"),
        Says("{seq}: has no rgb.txt; the sequence's images are listed in rgb.txt and depth.txt"),
    ),
    Case(
        "a name with a zero byte",
        edit("rgb.txt", replaced("rgb/", "rgb/\0")),
        Says(
            "{seq}/rgb/\\x001305031102.000000.png: is listed but not there (8 such files); copy the whole"
            " sequence again"
        ),
    ),
    Case(
        "a name with control characters",
        edit("rgb.txt", replaced("rgb/", "rgb/\x1b[31m")),
        Says(
            "{seq}/rgb/\\x1b[31m1305031102.000000.png: is listed but not there (8 such files); copy the"
            " whole sequence again"
        ),
    ),
    Case(
        "a name of 5000 letters",
        edit("rgb.txt", replaced("rgb/", "rgb/" + 5000 * "x")),
        Says(
            "{seq}/rgb/...1305031102.000000.png: cannot be read (File name too long); check its name and"
            " who may read it"
        ),
    ),
    Case(
        "a list in Latin-1",
        edit("rgb.txt", lambda content: b"# Gr\xfc\xdfe\n" + content),
        Says("{seq}/rgb.txt: is not a UTF-8 text file; convert it to UTF-8 (a list has lines of a stamp and a file)"),
    ),
    Case(
        "a list in UTF-16",
        edit("rgb.txt", lambda content: content.decode().encode("utf-16")),
        Says("{seq}/rgb.txt: is not a UTF-8 text file; convert it to UTF-8 (a list has lines of a stamp and a file)"),
    ),
    Case(
        "an image for a list",
        lambda place: (place.folder / FIRST).rename(place.folder / "rgb.txt"),
        Says("{seq}/rgb.txt: is not a UTF-8 text file; convert it to UTF-8 (a list has lines of a stamp and a file)"),
    ),
    Case("associations", associated("T C T D"), Right()),
    Case("associations, depth first", associated("T D T C"), Right()),
    Case(
        "associations without the second stamp",
        associated("T C D"),
        Says(
            "{seq}/associations.txt: line 1 is '1305031102.000000 rgb/1305031102.000000.png"
            " depth/1305031102.000000.png' where stamp, file, stamp, file are expected; write it so, or"
            " leave only rgb.txt and depth.txt there"
        ),
    ),
    Case(
        "associations without names",
        associated("T T"),
        Says(
            "{seq}/associations.txt: line 1 is '1305031102.000000 1305031102.000000' where stamp, file,"
            " stamp, file are expected; write it so, or leave only rgb.txt and depth.txt there"
        ),
    ),
    Case(
        "associations with a line of a million blanks",
        write("associations.txt", "1" + 1_000_000 * " " + "x"),
        Says(
            "{seq}/associations.txt: line 1 is '1 ...' where stamp, file, stamp, file are expected;"
            " write it so, or leave only rgb.txt and depth.txt there"
        ),
    ),
    Case(
        "associations of the names only",
        associated("C D"),
        Says(
            "{seq}/associations.txt: line 1 is 'rgb/1305031102.000000.png depth/1305031102.000000.png'"
            " where stamp, file, stamp, file are expected; write it so, or leave only rgb.txt and depth.txt"
            " there"
        ),
    ),
    Case("one frame", frames([3]), Right(1, ate=None)),
    Case("two frames", frames([3, 4]), Right(2, ate=None)),
    Case("frames dropped at random", frames([0, 1, 3, 4, 7]), Right(5)),
    Case("depth for every other frame", lines("depth.txt", lambda listed: listed[::2]), Right(4)),
]
