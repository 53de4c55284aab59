"""Ground truth: it does not touch the run, only the scores."""

from __future__ import annotations

from helpers.corpus.base import STAMPS
from helpers.corpus.case import Case, Make, Right, Says, edit, remove, replaced, write
from helpers.corpus.lists import folder_at, lines, loop, stamps_as

TRUTH = "groundtruth.txt"


def number(column: int, value: str, row: int = 3) -> Make:
    """Write another number into a row."""

    def change(listed: list[str]) -> list[str]:
        words = listed[row].split()
        words[column] = value
        return [*listed[:row], " ".join(words), *listed[row + 1 :]]

    return lines(TRUTH, change)


def quaternions(change: object) -> Make:
    def rows(listed: list[str]) -> list[str]:
        return [" ".join([*line.split()[:4], *(change(word) for word in line.split()[4:])]) for line in listed]

    return lines(TRUTH, rows)


X = Says("?", kept=8)

CASES = [
    Case("no ground truth", remove(TRUTH), Right(ate=None)),
    Case("Windows line ends", edit(TRUTH, replaced("\n", "\r\n")), Right()),
    Case("byte order mark", edit(TRUTH, lambda content: b"\xef\xbb\xbf" + content), Right()),
    Case("comments", edit(TRUTH, lambda content: b"# ground truth trajectory\n" + content), Right()),
    Case("commas", edit(TRUTH, replaced(" ", ",")), Right()),
    Case("backwards", lines(TRUTH, lambda listed: listed[::-1]), Right()),
    Case("a stamp twice", lines(TRUTH, lambda listed: [*listed, listed[0].replace(" ", " 9", 1)]), Right()),
    Case("quaternions twice as long", quaternions(lambda word: str(2 * float(word))), Right()),
    Case("stamps in nanoseconds as NumPy writes them", stamps_as(lambda s: f"{s * 1e9:.18e}", (TRUTH,)), Right()),
    Case(
        "a position that is not a number",
        number(1, "nan"),
        Says(
            "{seq}/groundtruth.txt: line 4 has a number that is not finite; remove or repair it (the"
            " results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "an infinite position",
        number(2, "-inf"),
        Says(
            "{seq}/groundtruth.txt: line 4 has a number that is not finite; remove or repair it (the"
            " results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "a position too large for a number",
        number(2, "1e999"),
        Says(
            "{seq}/groundtruth.txt: line 4 has a number that is not finite; remove or repair it (the"
            " results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "a position beyond the solar system",
        number(1, "1e200"),
        Says(
            "{seq}/groundtruth.txt: line 4 has a position more than 1e+07 m away; remove or repair it (the"
            " results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "a quaternion of NaN",
        quaternions(lambda word: "nan"),
        Says(
            "{seq}/groundtruth.txt: line 1 has a number that is not finite; remove or repair it (the"
            " results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "a quaternion of zeros",
        quaternions(lambda word: "0"),
        Says(
            "{seq}/groundtruth.txt: line 1 has a quaternion of zeros, or far from a unit one;"
            " remove or repair it (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "a quaternion of next to nothing",
        quaternions(lambda word: "1e-200"),
        Says(
            "{seq}/groundtruth.txt: line 1 has a quaternion of zeros, or far from a unit one;"
            " remove or repair it (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "an endless quaternion",
        quaternions(lambda word: "1e200"),
        Says(
            "{seq}/groundtruth.txt: line 1 has a quaternion of zeros, or far from a unit one;"
            " remove or repair it (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "seven columns",
        lines(TRUTH, lambda listed: [line.rsplit(maxsplit=1)[0] for line in listed]),
        Says(
            "{seq}/groundtruth.txt: line 1 is '1305031102.000000 0.000000000 0.062500000 0.000000000"
            " 0.000000000 0.000000000 0.' where stamp tx ty tz qx qy qz qw is expected; repair it (the"
            " results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "words",
        number(3, "unknown"),
        Says(
            "{seq}/groundtruth.txt: line 4 is '1305031102.300000 0.093750000 0.156250000 unknown"
            " 0.000001500 0.000000000 0.0000' where stamp tx ty tz qx qy qz qw is expected; repair it (the"
            " results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "empty",
        write(TRUTH, ""),
        Says(
            "{seq}/groundtruth.txt: holds no pose; lines of stamp tx ty tz qx qy qz qw are expected, copy"
            " it again (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "comments only",
        write(TRUTH, "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"),
        Says(
            "{seq}/groundtruth.txt: holds no pose; lines of stamp tx ty tz qx qy qz qw are expected, copy"
            " it again (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "breaks off",
        edit(TRUTH, lambda content: content[:-30]),
        Says(
            "{seq}/groundtruth.txt: line 8 is '1305031102.700000 0.218750000 0.156250000 0.000000000"
            " 0.000003500 0.0000' where stamp tx ty tz qx qy qz qw is expected; repair it (the results are"
            " in {out})",
            kept=8,
        ),
    ),
    Case(
        "binary",
        write(TRUTH, bytes(range(256))),
        Says(
            "{seq}/groundtruth.txt: is not a UTF-8 text file; convert it to UTF-8 (a trajectory has lines"
            " of stamp tx ty tz qx qy qz qw) (the results are in {out})",
            kept=8,
        ),
    ),
    Case("a folder", folder_at(TRUTH), Right(ate=None)),
    Case("a loop of links", loop(TRUTH), Right(ate=None)),
    Case(
        "another clock",
        stamps_as(lambda s: f"{s + 3600:.6f}", (TRUTH,)),
        Says(
            "seq: has no scores, only 0 poses of the estimate (1305031102.00 to 1305031102.70 s) lie within"
            " 0.02 s of the ground truth (1305034702.00 to 1305034702.70 s), at least 3 are needed; are they"
            " of the same sequence? (the results are in {out})",
            kept=8,
        ),
    ),
    Case(
        "two poses",
        lines(TRUTH, lambda listed: listed[:2]),
        Says(
            "seq: has no scores, only 2 poses of the estimate (1305031102.00 to 1305031102.70 s) lie within"
            " 0.02 s of the ground truth (1305031102.00 to 1305031102.10 s), at least 3 are needed; are they"
            " of the same sequence? (the results are in {out})",
            kept=8,
        ),
    ),
    Case("the camera never moves", number(0, STAMPS[3]), Right()),
    Case("every orientation the same", quaternions(lambda word: word[:3]), Right()),
]
