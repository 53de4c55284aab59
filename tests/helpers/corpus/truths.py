"""Damaged ground truth, which affects only the scores of a run."""

from __future__ import annotations

from helpers.corpus.base import STAMPS
from helpers.corpus.case import Case, Damage, Succeeds, edit, fails_after_run, remove, replace_text, write
from helpers.corpus.lists import lines, make_folder, make_symlink_loop, stamps_as

GROUND_TRUTH = "groundtruth.txt"


def number(column: int, value: str, row: int = 3) -> Damage:
    """Replace a number in a row of the ground truth."""

    def change(listed: list[str]) -> list[str]:
        words = listed[row].split()
        words[column] = value
        return [*listed[:row], " ".join(words), *listed[row + 1 :]]

    return lines(GROUND_TRUTH, change)


def quaternions(change: object) -> Damage:
    """Change all numbers of all quaternions."""

    def rows(listed: list[str]) -> list[str]:
        return [" ".join([*line.split()[:4], *(change(word) for word in line.split()[4:])]) for line in listed]

    return lines(GROUND_TRUTH, rows)


CASES = [
    Case("no ground truth", remove(GROUND_TRUTH), Succeeds(max_ate=None)),
    Case("Windows line endings", edit(GROUND_TRUTH, replace_text("\n", "\r\n")), Succeeds()),
    Case("byte order mark", edit(GROUND_TRUTH, lambda content: b"\xef\xbb\xbf" + content), Succeeds()),
    Case("comments", edit(GROUND_TRUTH, lambda content: b"# ground truth trajectory\n" + content), Succeeds()),
    Case("commas", edit(GROUND_TRUTH, replace_text(" ", ",")), Succeeds()),
    Case("lines in reverse order", lines(GROUND_TRUTH, lambda listed: listed[::-1]), Succeeds()),
    Case(
        "duplicate timestamp",
        lines(GROUND_TRUTH, lambda listed: [*listed, listed[0].replace(" ", " 9", 1)]),
        Succeeds(),
    ),
    Case("quaternions of length two", quaternions(lambda word: str(2 * float(word))), Succeeds()),
    Case(
        "timestamps in nanoseconds in NumPy's notation",
        stamps_as(lambda s: f"{s * 1e9:.18e}", (GROUND_TRUTH,)),
        Succeeds(),
    ),
    Case(
        "position NaN",
        number(1, "nan"),
        Succeeds(note="1 of 8 poses of the ground truth are empty or not finite and are left out"),
    ),
    Case(
        "infinite position",
        number(2, "-inf"),
        Succeeds(note="1 of 8 poses of the ground truth are empty or not finite and are left out"),
    ),
    Case(
        "position beyond float64",
        number(2, "1e999"),
        Succeeds(note="1 of 8 poses of the ground truth are empty or not finite and are left out"),
    ),
    Case(
        "position far beyond the earth's radius",
        number(1, "1e200"),
        fails_after_run("{seq}/groundtruth.txt: line 4 has a position more than 1e+07 m away; correct or remove it"),
    ),
    Case(
        "quaternion of NaN",
        quaternions(lambda word: "nan"),
        fails_after_run("{seq}/groundtruth.txt: line 1 has a number that is not finite; correct or remove it"),
    ),
    Case(
        "zero quaternion",
        quaternions(lambda word: "0"),
        fails_after_run(
            "{seq}/groundtruth.txt: line 1 has a quaternion that is zero or far from unit length; correct or remove it"
        ),
    ),
    Case(
        "quaternion of tiny numbers",
        quaternions(lambda word: "1e-200"),
        fails_after_run(
            "{seq}/groundtruth.txt: line 1 has a quaternion that is zero or far from unit length; correct or remove it"
        ),
    ),
    Case(
        "quaternion of huge numbers",
        quaternions(lambda word: "1e200"),
        fails_after_run(
            "{seq}/groundtruth.txt: line 1 has a quaternion that is zero or far from unit length; correct or remove it"
        ),
    ),
    Case(
        "seven columns",
        lines(GROUND_TRUTH, lambda listed: [line.rsplit(maxsplit=1)[0] for line in listed]),
        fails_after_run(
            "{seq}/groundtruth.txt: line 1 is '1305031102.000000 0.000000000 0.062500000 0.000000000 0.000000000"
            " 0.000000000 0.', expected timestamp tx ty tz qx qy qz qw; correct or remove it"
        ),
    ),
    Case(
        "nine columns",
        lines(GROUND_TRUTH, lambda listed: [f"{line} 1" for line in listed]),
        fails_after_run(
            "{seq}/groundtruth.txt: line 1 has 9 columns, expected 8: timestamp tx ty tz qx qy qz qw; remove the others"
        ),
    ),
    Case(
        "word instead of a number",
        number(3, "unknown"),
        fails_after_run(
            "{seq}/groundtruth.txt: line 4 is '1305031102.300000 0.093750000 0.156250000 unknown 0.000001500"
            " 0.000000000 0.0000', expected timestamp tx ty tz qx qy qz qw; correct or remove it"
        ),
    ),
    Case(
        "empty file",
        write(GROUND_TRUTH, ""),
        fails_after_run(
            "{seq}/groundtruth.txt: contains no poses; copy it again, it must have lines of timestamp tx ty tz"
            " qx qy qz qw"
        ),
    ),
    Case(
        "comments only",
        write(GROUND_TRUTH, "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"),
        fails_after_run(
            "{seq}/groundtruth.txt: contains no poses; copy it again, it must have lines of timestamp tx ty tz"
            " qx qy qz qw"
        ),
    ),
    Case(
        "truncated file",
        edit(GROUND_TRUTH, lambda content: content[:-30]),
        fails_after_run(
            "{seq}/groundtruth.txt: line 8 is '1305031102.700000 0.218750000 0.156250000 0.000000000 0.000003500"
            " 0.0000', expected timestamp tx ty tz qx qy qz qw; correct or remove it"
        ),
    ),
    Case(
        "binary file",
        write(GROUND_TRUTH, bytes(range(256))),
        fails_after_run(
            "{seq}/groundtruth.txt: is not a UTF-8 text file; convert it to UTF-8 (a trajectory has lines of"
            " timestamp tx ty tz qx qy qz qw)"
        ),
    ),
    Case("folder instead of a file", make_folder(GROUND_TRUTH), Succeeds(max_ate=None)),
    Case("symlink loop", make_symlink_loop(GROUND_TRUTH), Succeeds(max_ate=None)),
    Case(
        "different clock",
        stamps_as(lambda s: f"{s + 3600:.6f}", (GROUND_TRUTH,)),
        fails_after_run(
            "seq: has no scores, only 0 of 8 poses of the estimate (1305031102.00 to 1305031102.70 s) are within 0.02"
            " s of the ground truth (1305034702.00 to 1305034702.70 s), at least 3 are needed; check that both"
            " belong to the same sequence"
        ),
    ),
    Case(
        "two poses",
        lines(GROUND_TRUTH, lambda listed: listed[:2]),
        fails_after_run(
            "seq: has no scores, only 2 of 8 poses of the estimate (1305031102.00 to 1305031102.70 s) are within 0.02"
            " s of the ground truth (1305031102.00 to 1305031102.10 s), at least 3 are needed; check that both"
            " belong to the same sequence"
        ),
    ),
    Case("camera at rest", number(0, STAMPS[3]), Succeeds()),
    Case("constant orientation", quaternions(lambda word: word[:3]), Succeeds()),
]
