"""Damaged lists of images."""

from __future__ import annotations

from collections.abc import Callable

from helpers.corpus.base import STAMPS
from helpers.corpus.case import Case, Damage, Fails, Succeeds, Workspace, all_of, edit, remove, replace_text, write


def stamps_as(
    form: Callable[[float], str], files: tuple[str, ...] = ("rgb.txt", "depth.txt", "groundtruth.txt")
) -> Damage:
    """Write the timestamps of these files in another form."""

    def make(place: Workspace) -> None:
        for file in files:
            path = place.folder / file
            lines = [line.split(maxsplit=1) for line in path.read_text().splitlines()]
            path.write_text("".join(f"{form(float(stamp))} {rest}\n" for stamp, rest in lines))

    return make


def renamed(change: Callable[[str, str], str], *, absolute: bool = False) -> Damage:
    """Rename the images by kind and timestamp, also in the lists."""

    def make(place: Workspace) -> None:
        for kind in ("rgb", "depth"):
            lines = []
            for stamp in STAMPS:
                name = change(kind, stamp)
                (place.folder / name).parent.mkdir(parents=True, exist_ok=True)
                (place.folder / kind / f"{stamp}.png").rename(place.folder / name)
                lines.append(f"{stamp} {place.folder / name if absolute else name}\n")
            (place.folder / f"{kind}.txt").write_text("".join(lines))

    return make


def lines(file: str, change: Callable[[list[str]], list[str]]) -> Damage:
    """Change the lines of a file of the sequence."""

    def make(place: Workspace) -> None:
        path = place.folder / file
        path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))

    return make


def associated(form: str) -> Damage:
    """Write ``associations.txt`` by a line format in which T, C and D are timestamp, colour and depth image."""

    def make(place: Workspace) -> None:
        text = "".join(
            form.replace("T", s).replace("C", f"rgb/{s}.png").replace("D", f"depth/{s}.png") + "\n" for s in STAMPS
        )
        (place.folder / "associations.txt").write_text(text)

    return make


def frames(keep: list[int]) -> Damage:
    """Keep only these frames in the lists."""

    def pick(listed: list[str]) -> list[str]:
        return [listed[i] for i in keep]

    return all_of(lines("rgb.txt", pick), lines("depth.txt", pick))


def make_symlink_loop(file: str) -> Damage:
    """Replace a file by a symlink to itself."""

    def make(place: Workspace) -> None:
        path = place.folder / file
        path.unlink()
        path.symlink_to(path.name)

    return make


def make_folder(file: str) -> Damage:
    """Replace a file by a folder."""

    def make(place: Workspace) -> None:
        path = place.folder / file
        path.unlink()
        path.mkdir()

    return make


FIRST = f"rgb/{STAMPS[0]}.png"

CASES = [
    Case("Windows line endings", edit("rgb.txt", replace_text("\n", "\r\n")), Succeeds()),
    Case("classic Mac line endings", edit("rgb.txt", replace_text("\n", "\r")), Succeeds()),
    Case("byte order mark", edit("rgb.txt", lambda content: b"\xef\xbb\xbf" + content), Succeeds()),
    Case(
        "comments and blank lines",
        edit("depth.txt", lambda c: b"# depth maps\n#\n\n" + c.replace(b"\n", b"\n\n# x\n")),
        Succeeds(),
    ),
    Case("tabs", edit("rgb.txt", replace_text(" ", "\t")), Succeeds()),
    Case("commas", edit("rgb.txt", replace_text(" ", ", ")), Succeeds()),
    Case("spaces in file names", renamed(lambda kind, stamp: f"{kind}/my take {stamp}.png"), Succeeds()),
    Case("non-ASCII file names", renamed(lambda kind, stamp: f"bilder für {kind}/{stamp} 深度.png"), Succeeds()),
    Case("backslashes of Windows", edit("rgb.txt", replace_text("rgb/", "rgb\\")), Succeeds()),
    Case(
        "backslashes of Windows in associations",
        all_of(associated("T C T D"), edit("associations.txt", replace_text("/", "\\"))),
        Succeeds(),
    ),
    Case(
        "paths of a disk of Windows",
        edit("rgb.txt", replace_text("rgb/", "C:\\data\\rgb\\")),
        Fails(
            "{seq}/C:\\data\\rgb\\1305031102.000000.png: is listed but does not exist (8 missing in total); the list"
            " has Windows paths; write them relative to its folder, such as rgb/1.png"
        ),
    ),
    Case(
        "paths of a disk of Windows with slashes",
        edit("rgb.txt", replace_text("rgb/", "C:/data/rgb/")),
        Fails(
            "{seq}/C:/data/rgb/1305031102.000000.png: is listed but does not exist (8 missing in total); the list has"
            " Windows paths; write them relative to its folder, such as rgb/1.png"
        ),
    ),
    Case(
        "missing file with a backslash in its name",
        edit("rgb.txt", replace_text("rgb/", "rgb/left\\")),
        Fails(
            "{seq}/rgb/left\\1305031102.000000.png: is listed but does not exist (8 missing in total); copy the whole"
            " sequence again"
        ),
    ),
    Case("no-break spaces", edit("rgb.txt", replace_text(" ", "\u00a0")), Succeeds()),
    Case("no-break spaces at the ends of lines", edit("depth.txt", replace_text("\n", "\u00a0\n")), Succeeds()),
    Case("invisible spaces", edit("rgb.txt", replace_text(" ", "\u200b \u200b")), Succeeds()),
    Case("no-break spaces in the ground truth", edit("groundtruth.txt", replace_text(" ", "\u00a0\u2009")), Succeeds()),
    Case("absolute paths", renamed(lambda kind, stamp: f"{kind}/{stamp}.png", absolute=True), Succeeds()),
    Case("paths through the parent folder", edit("rgb.txt", replace_text("rgb/", "../seq/rgb/")), Succeeds()),
    Case(
        "duplicate timestamp",
        lines("rgb.txt", lambda listed: [*listed, listed[3].split()[0] + f" {FIRST}"]),
        Succeeds(),
    ),
    Case(
        "lines out of order", lines("rgb.txt", lambda listed: [listed[i] for i in (3, 0, 7, 1, 6, 2, 5, 4)]), Succeeds()
    ),
    Case("timestamps in nanoseconds", stamps_as(lambda s: f"{s * 1e9:.0f}"), Succeeds()),
    Case("timestamps in microseconds", stamps_as(lambda s: f"{s * 1e6:.0f}"), Succeeds()),
    Case("timestamps in milliseconds", stamps_as(lambda s: f"{s * 1e3:.0f}"), Succeeds()),
    Case(
        "milliseconds since the first frame",
        stamps_as(lambda s: f"{(s - 1305031102) * 1e3:.0f}"),
        Fails(
            "{seq}: the images are 100 s apart according to their timestamps; convert the timestamps to"
            " seconds (they are probably in milliseconds or nanoseconds)"
        ),
    ),
    Case(
        "nanoseconds since the first frame",
        stamps_as(lambda s: f"{(s - 1305031102) * 1e9:.0f}"),
        Fails(
            "{seq}: the images are 9.99999e+07 s apart according to their timestamps; convert the timestamps to"
            " seconds (they are probably in milliseconds or nanoseconds)"
        ),
    ),
    Case("negative timestamps", stamps_as(lambda s: f"{s - 1305031102.35:.6f}"), Succeeds()),
    Case(
        "words instead of timestamps",
        lines("rgb.txt", lambda listed: [f"frame{i} {line.split()[1]}" for i, line in enumerate(listed)]),
        Fails("{seq}/rgb.txt: line 1 has 'frame0', expected a timestamp in seconds; correct or remove the line"),
    ),
    Case(
        "timestamp NaN",
        lines("rgb.txt", lambda listed: [*listed[:3], f"nan {FIRST}", *listed[3:]]),
        Fails("{seq}/rgb.txt: line 4 has 'nan', expected a timestamp in seconds; correct or remove the line"),
    ),
    Case(
        "infinite timestamp",
        lines("depth.txt", lambda listed: [f"inf {FIRST}", *listed]),
        Fails("{seq}/depth.txt: line 1 has 'inf', expected a timestamp in seconds; correct or remove the line"),
    ),
    Case(
        "lists with different clocks",
        stamps_as(lambda s: f"{s + 10:.6f}", ("depth.txt",)),
        Fails(
            "{seq}: no timestamp in rgb.txt is within 0.02 s of one in depth.txt; check that both lists belong"
            " to the same recording"
        ),
    ),
    Case(
        "empty list",
        write("rgb.txt", ""),
        Fails("{seq}/rgb.txt: lists no images; a list has a timestamp and a file name on each line, copy it again"),
    ),
    Case(
        "list with comments only",
        write("depth.txt", "# depth maps\n"),
        Fails("{seq}/depth.txt: lists no images; a list has a timestamp and a file name on each line, copy it again"),
    ),
    Case(
        "missing colour list",
        remove("rgb.txt"),
        Fails("{seq}: has no rgb.txt; list the images of the sequence in rgb.txt and depth.txt"),
    ),
    Case(
        "missing depth list",
        remove("depth.txt"),
        Fails("{seq}: has no depth.txt; list the images of the sequence in rgb.txt and depth.txt"),
    ),
    Case("missing lists", remove("rgb.txt", "depth.txt"), Succeeds(max_ate=None)),
    Case(
        "missing listed image",
        remove(FIRST),
        Fails(
            "{seq}/rgb/1305031102.000000.png: is listed but does not exist (1 missing in total); copy the whole"
            " sequence again"
        ),
    ),
    Case(
        "truncated last line",
        edit("rgb.txt", lambda content: content[:-5]),
        Fails(
            "{seq}/rgb/1305031102.700000: is listed but does not exist (1 missing in total); copy the whole"
            " sequence again"
        ),
    ),
    Case(
        "line without a file name",
        lines("rgb.txt", lambda listed: [*listed[:3], STAMPS[3], *listed[4:]]),
        Fails(
            "{seq}/rgb.txt: line 4 is '1305031102.300000', expected a timestamp and a file name; correct or remove it"
        ),
    ),
    Case(
        "listed image is a folder",
        make_folder(FIRST),
        Fails(
            "{seq}/rgb/1305031102.000000.png: is listed but does not exist (1 missing in total); copy the whole"
            " sequence again"
        ),
    ),
    Case(
        "listed image is a symlink loop",
        make_symlink_loop(FIRST),
        Fails(
            "{seq}/rgb/1305031102.000000.png: is listed but does not exist (1 missing in total); copy the whole"
            " sequence again"
        ),
    ),
    Case(
        "list is a symlink loop",
        make_symlink_loop("rgb.txt"),
        Fails("{seq}: has no rgb.txt; list the images of the sequence in rgb.txt and depth.txt"),
    ),
    Case(
        "list is a folder",
        make_folder("rgb.txt"),
        Fails("{seq}: has no rgb.txt; list the images of the sequence in rgb.txt and depth.txt"),
    ),
    Case(
        "file name with a zero byte",
        edit("rgb.txt", replace_text("rgb/", "rgb/\0")),
        Fails(
            "{seq}/rgb/\\x001305031102.000000.png: is listed but does not exist (8 missing in total); copy the"
            " whole sequence again"
        ),
    ),
    Case(
        "file name with control characters",
        edit("rgb.txt", replace_text("rgb/", "rgb/\x1b[31m")),
        Fails(
            "{seq}/rgb/\\x1b[31m1305031102.000000.png: is listed but does not exist (8 missing in total); copy"
            " the whole sequence again"
        ),
    ),
    Case(
        "file name with 5000 letters",
        edit("rgb.txt", replace_text("rgb/", "rgb/" + 5000 * "x")),
        Fails(
            "{seq}/rgb/...1305031102.000000.png: cannot be read (File name too long); check its name and permissions"
        ),
    ),
    Case(
        "list in Latin-1",
        edit("rgb.txt", lambda content: b"# Gr\xfc\xdfe\n" + content),
        Fails(
            "{seq}/rgb.txt: is not a UTF-8 text file; convert it to UTF-8 (a list has a timestamp and a file"
            " name on each line)"
        ),
    ),
    Case(
        "list in UTF-16",
        edit("rgb.txt", lambda content: content.decode().encode("utf-16")),
        Fails(
            "{seq}/rgb.txt: is not a UTF-8 text file; convert it to UTF-8 (a list has a timestamp and a file"
            " name on each line)"
        ),
    ),
    Case(
        "image instead of a list",
        lambda place: (place.folder / FIRST).rename(place.folder / "rgb.txt"),
        Fails(
            "{seq}/rgb.txt: is not a UTF-8 text file; convert it to UTF-8 (a list has a timestamp and a file"
            " name on each line)"
        ),
    ),
    Case("associations", associated("T C T D"), Succeeds()),
    Case("associations, depth first", associated("T D T C"), Succeeds()),
    Case(
        "associations without the second timestamp",
        associated("T C D"),
        Fails(
            "{seq}/associations.txt: line 1 is '1305031102.000000 rgb/1305031102.000000.png"
            " depth/1305031102.000000.png', expected timestamp, file, timestamp, file; correct it, or remove"
            " this list and use rgb.txt and depth.txt"
        ),
    ),
    Case(
        "associations without file names",
        associated("T T"),
        Fails(
            "{seq}/associations.txt: line 1 is '1305031102.000000 1305031102.000000', expected timestamp, file,"
            " timestamp, file; correct it, or remove this list and use rgb.txt and depth.txt"
        ),
    ),
    Case(
        "associations with a million blanks in a line",
        write("associations.txt", "1" + 1_000_000 * " " + "x"),
        Fails(
            "{seq}/associations.txt: line 1 is '1 ...', expected timestamp, file, timestamp, file; correct it,"
            " or remove this list and use rgb.txt and depth.txt"
        ),
    ),
    Case(
        "associations with file names only",
        associated("C D"),
        Fails(
            "{seq}/associations.txt: line 1 is 'rgb/1305031102.000000.png depth/1305031102.000000.png',"
            " expected timestamp, file, timestamp, file; correct it, or remove this list and use rgb.txt and"
            " depth.txt"
        ),
    ),
    Case("one frame", frames([3]), Succeeds(1, max_ate=None, note="note: only 1 pose: at least 3")),
    Case("two frames", frames([3, 4]), Succeeds(2, max_ate=None, note="note: only 2 poses: at least 3")),
    Case("frames dropped irregularly", frames([0, 1, 3, 4, 7]), Succeeds(5)),
    Case("depth for every other frame", lines("depth.txt", lambda listed: listed[::2]), Succeeds(4)),
]
