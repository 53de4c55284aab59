"""Image lists of the TUM layout."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from v3d_torch.datasets.lists import ImagePair, check_stamp_unit, pair_lists, read_associations, read_image_list
from v3d_torch.errors import InputError

STAMPS = st.floats(min_value=-1e10, max_value=1e10, allow_nan=False)
WORDS = st.lists(st.text("abz09#,", min_size=1, max_size=6), max_size=3)
NAMES = st.builds(lambda first, words: f"rgb/{' '.join([first, *words])}.png", st.text("abz09_-", min_size=1), WORDS)
"""File names with spaces; after the first space also with characters that begin a comment or separate columns."""

FILE_SETTINGS = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@given(
    entries=st.lists(st.tuples(STAMPS, NAMES), min_size=1, max_size=8),
    noise=st.lists(st.sampled_from(["", "   ", "# comment", "#1.0 rgb/x.png", "\t"]), max_size=5),
    ending=st.sampled_from(["\n", "\r\n", "\r"]),
    mark=st.booleans(),
    gap=st.sampled_from([" ", "\t", "   ", ", "]),
)
@FILE_SETTINGS
def test_image_list_is_read_with_any_whitespace_comments_and_line_ends(
    tmp_path: Path, entries: list[tuple[float, str]], noise: list[str], ending: str, mark: bool, gap: str
) -> None:
    lines = [*noise, *(f" {stamp!r}{gap}{name} " for stamp, name in entries), *noise]
    (tmp_path / "rgb.txt").write_bytes(ending.join(lines).encode("utf-8-sig" if mark else "utf-8"))
    first = dict(reversed(entries))
    assert read_image_list(tmp_path / "rgb.txt") == [(stamp, first[stamp]) for stamp in sorted(first)]


@given(entries=st.lists(st.tuples(STAMPS, NAMES, STAMPS, NAMES), min_size=1, max_size=8))
@FILE_SETTINGS
def test_associations_with_spaces_in_file_names_are_read(
    tmp_path: Path, entries: list[tuple[float, str, float, str]]
) -> None:
    path = tmp_path / "associations.txt"
    path.write_text("".join(f"{a!r} {colour} {b!r} {depth}\n" for a, colour, b, depth in entries))
    first = {entry[0]: (entry[0], entry[1], entry[3]) for entry in reversed(entries)}
    found = [(pair.stamp, pair.colour, pair.depth) for pair in read_associations(path)[0]]
    assert found == [first[stamp] for stamp in sorted(first)]


def test_poses_after_the_second_file_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "associations.txt"
    lines = ["10.0 rgb/a.png 10.0 depth/a 1.png", "10.5 rgb/b.png 10.5 depth/b 2.png"]
    path.write_text("\n".join(lines))
    expected = read_associations(path)
    path.write_text("\n".join(f"{line} 10.01 1.34 0.63 1.66 0.66 0.61 -2.9e-01 -0.32" for line in lines))
    assert read_associations(path) == expected


def test_depth_delay_is_depth_stamp_minus_colour_stamp(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_text("10.0 rgb/a.png\n10.5 rgb/b.png\n")
    (tmp_path / "depth.txt").write_text("9.984375 depth/a.png\n10.515625 depth/b.png\n")
    path = tmp_path / "associations.txt"
    lines = ["10.0 rgb/a.png 9.984375 depth/a.png", "10.5 rgb/b.png 10.515625 depth/b.png"]
    path.write_text("\n".join(lines))
    listed, paired = read_associations(path), pair_lists(tmp_path / "rgb.txt", tmp_path / "depth.txt")
    assert listed == paired and listed[1] is None
    assert [pair.depth_delay for pair in listed[0]] == [-1 / 64, 1 / 64]
    path.write_text("10.0 rgb/a.png 5009.99 depth/a.png")  # stamps of two clocks give no delay
    pairs, note = read_associations(path)
    assert [pair.depth_delay for pair in pairs] == [0.0]
    assert note == (
        f"{path}: the timestamps of 1 of 1 pairs are more than 20 ms apart (median of depth minus colour 4999.990 s);"
        " colour and depth of these pairs count as simultaneous"
    )


def write_lists(folder: Path, colour: Iterable[float], depth: Iterable[float]) -> tuple[Path, Path]:
    for kind, stamps in (("rgb", colour), ("depth", depth)):
        (folder / f"{kind}.txt").write_text("".join(f"{stamp:.6f} {kind}/{stamp:.6f}.png\n" for stamp in stamps))
    return folder / "rgb.txt", folder / "depth.txt"


@pytest.mark.parametrize(
    ("depth", "left_out", "last"),
    [
        (range(60), 0, 0.0),
        (range(20), 40, 59 / 30),
        (range(0, 60, 2), 30, 59 / 30),  # depth at half of the rate of colour
        (range(10, 80), 10, 9 / 30),
        ([*range(30), *range(33, 60)], 3, 32 / 30),
    ],
)
def test_colour_images_without_depth_are_noted(
    tmp_path: Path, depth: Iterable[int], left_out: int, last: float
) -> None:
    lists = write_lists(tmp_path, (i / 30 for i in range(60)), (i / 30 + 0.004 for i in depth))
    pairs, note = pair_lists(*lists)
    assert len(pairs) == 60 - left_out
    words = (
        f"{left_out} of 60 colour images have no depth image within 20 ms and are left out (the last at {last:.6f} s)"
    )
    assert note == (words if left_out else None)


def test_lists_that_do_not_match_are_an_error(tmp_path: Path) -> None:
    lists = write_lists(tmp_path, (i / 10 for i in range(60)), (i / 10.3 for i in range(60)))  # another clock
    message = r"only \d+ of 60 colour and 60 depth images are within 20 ms of each other; check that both belong"
    with pytest.raises(InputError, match=message):
        pair_lists(*lists)


def test_colour_at_a_lower_rate_than_depth_needs_no_note(tmp_path: Path) -> None:
    assert pair_lists(*write_lists(tmp_path, range(10), (i / 10 for i in range(100))))[1] is None


@pytest.mark.parametrize("written", ["rgb\\{}", "rgb/{}\u00a0", "rgb\u200b/{}", "\u00a0rgb\\{}\u200b"])
def test_backslashes_and_odd_spaces_in_file_names_are_understood(tmp_path: Path, written: str) -> None:
    (tmp_path / "rgb").mkdir()
    for name in ("a.png", "b c.png"):
        (tmp_path / "rgb" / name).touch()
    listed = [written.format(name) for name in ("a.png", "b c.png")]
    (tmp_path / "rgb.txt").write_text(f"1.0\u00a0{listed[0]}\r\n2.0\u200b {listed[1]}\n", encoding="utf-8")
    assert read_image_list(tmp_path / "rgb.txt") == [(1.0, "rgb/a.png"), (2.0, "rgb/b c.png")]
    lines = f"1.0 {listed[0]} 1.01\u200b {listed[1]}\n"
    (tmp_path / "associations.txt").write_text(lines, encoding="utf-8")
    ((pair,), _) = read_associations(tmp_path / "associations.txt")
    assert (pair.colour, pair.depth, pair.depth_delay) == ("rgb/a.png", "rgb/b c.png", pytest.approx(0.01))


def test_file_names_that_exist_are_not_changed(tmp_path: Path) -> None:
    names = ["back\\slash.png", "no\u00a0break.png", "zero\u200bwidth.png"]
    for name in names:
        (tmp_path / name).touch()
    (tmp_path / "rgb.txt").write_text("".join(f"{i}.0 {name}\n" for i, name in enumerate(names)), encoding="utf-8")
    assert [name for _, name in read_image_list(tmp_path / "rgb.txt")] == names


@given(content=st.binary(max_size=200))
@FILE_SETTINGS
def test_any_bytes_are_a_valid_list_or_raise_input_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "rgb.txt").write_bytes(content)
    for read in (read_image_list, read_associations):
        try:
            assert read(tmp_path / "rgb.txt")
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(("gap", "is_plausible"), [(9.0, True), (11.0, False), (0.0011, True), (0.0009, False)])
def test_median_time_between_images_is_a_millisecond_to_ten_seconds(
    tmp_path: Path, gap: float, is_plausible: bool
) -> None:
    pairs = [ImagePair(stamp, "rgb.png", "depth.png") for stamp in (0.0, gap, 2 * gap, 2 * gap + 100)]
    if is_plausible:
        check_stamp_unit(pairs, tmp_path)
    else:
        with pytest.raises(InputError, match=f"the images are {gap:g} s apart according to their timestamps"):
            check_stamp_unit(pairs, tmp_path)
