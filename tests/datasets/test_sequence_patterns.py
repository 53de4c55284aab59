"""Sequence patterns: paths, names in the data root, names of the benchmark."""

from __future__ import annotations

from errno import EACCES
from pathlib import Path

import pytest
from helpers.tiny_images import colour_of, save

from v3d_torch.datasets import open_source
from v3d_torch.datasets.sequence_names import PAPER_SEQUENCES, SEQUENCES, short_name
from v3d_torch.datasets.sequence_patterns import matching_sequences
from v3d_torch.errors import InputError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Folder with sequences and other files."""
    for name in ("walk_a", "walk_b", "sit", "rgbd_dataset_freiburg1_rpy", "fr1_xyz"):
        (tmp_path / "data" / name).mkdir(parents=True)
        (tmp_path / "data" / name / "rgb.txt").write_text("")
    (tmp_path / "data" / "walk_notes").mkdir()
    (tmp_path / "data" / "README.md").write_text("")
    return tmp_path / "data"


def find(patterns: list[str], root: Path | None = None) -> list[str]:
    """Sequences that match patterns."""
    return list(matching_sequences(patterns, root).sequences)


def test_names_without_wildcard_are_returned_unchanged(root: Path) -> None:
    assert find(["demo", "nowhere", "fr3/w/xyz", "demo"], root) == ["demo", "nowhere", "fr3/w/xyz"]


def test_existing_folder_with_brackets_is_not_a_pattern(root: Path) -> None:
    (root / "take [1]").mkdir()
    assert find([str(root / "take [1]")], root) == [str(root / "take [1]")]


def test_pattern_matches_only_sequences_in_data_root(root: Path) -> None:
    assert find(["walk_*"], root) == ["walk_a", "walk_b"]
    assert find(["*"], root) == ["fr1_xyz", "rgbd_dataset_freiburg1_rpy", "sit", "walk_a", "walk_b"]
    assert find(["walk_[!a]", "s?t"], root) == ["walk_b", "sit"]


def test_folders_without_depth_match_no_pattern(root: Path) -> None:
    for name in ("images", "img"):
        save(root / "website" / name / "1.png", colour_of(0))
    assert find([str(root / "w*")]) == [str(root / "walk_a"), str(root / "walk_b")]


def test_folder_that_cannot_be_read_matches_no_pattern(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (root / "lost+found").mkdir()
    is_file = Path.is_file

    def refuse(path: Path) -> bool:
        if "lost+found" in path.parts:
            raise PermissionError(EACCES, "Permission denied", str(path))
        return is_file(path)

    monkeypatch.setattr(Path, "is_file", refuse)
    assert find([str(root / "[ls]*")]) == [str(root / "sit")]
    with pytest.raises(InputError, match=r"lost\+found.*: cannot be read \(Permission denied\)"):
        open_source(root / "lost+found")


def test_damaged_bag_is_matched_and_reported_when_it_is_opened(root: Path) -> None:
    (root / "walk_c.bag").write_bytes(b"#ROSBAG V2.0\n")
    assert find(["walk_*"], root) == ["walk_a", "walk_b", "walk_c.bag"]
    with pytest.raises(InputError, match=r"walk_c\.bag: is damaged or not a bag"):
        open_source(root / "walk_c.bag")


def test_pattern_matches_paths(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find([str(root / "walk*")]) == [str(root / "walk_a"), str(root / "walk_b")]
    monkeypatch.chdir(root.parent)
    assert find(["data/s*"], Path("elsewhere")) == ["data/sit"]


def test_pattern_matches_names_of_the_benchmark(root: Path) -> None:
    walking = ["fr3/w/xyz", "fr3/w/half", "fr3/w/static", "fr3/w/rpy"]
    for pattern in ("fr3/w/*", "fr3_walking_*", "freiburg3_walking*", "rgbd_dataset_freiburg3_walking_*", "FR3/W/*"):
        assert find([pattern], root) == walking
    third = find(["fr3/*"], root)
    assert third[:8] == [short_name(name) for name in PAPER_SEQUENCES]  # the paper's sequences come first, in its order
    others = [short_name(n) for n in SEQUENCES if "freiburg3" in n and not n.endswith("validation")]
    assert sorted(third) == sorted(others)


def test_validation_sequences_match_only_if_named(root: Path) -> None:
    found = find(["fr1/*_validation"], root)
    assert found and all(name.endswith("validation") for name in found)


def test_sequence_with_several_names_matches_once(root: Path) -> None:
    found = find(["fr1/rpy", "fr1/*", "freiburg1-rpy"], root)
    assert found[0] == "fr1/rpy" and found.count("fr1/rpy") == 1
    assert (
        len(set(found)) == len(found) == len([n for n in SEQUENCES if n.startswith("rgbd_dataset_freiburg1")]) / 2 + 1
    )
    assert find(["fr?_xyz"], root) == ["fr1_xyz", "fr2/xyz"]  # fr1_xyz is a folder in the data root


def test_spellings_of_one_folder_match_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root)
    (root.parent / "link").symlink_to(root / "sit")
    for patterns in (
        ["sit", "./sit", str(root / "sit"), "../link", "s?t"],
        [str(root / "rgbd_dataset_freiburg1_rpy"), "fr1/rpy", "freiburg1-rpy"],
    ):
        assert find(patterns, root) == patterns[:1]
    (root / "demo").mkdir()
    assert find(["demo", "./demo"], root) == ["demo", "./demo"]  # the rendered demo, and a folder


def test_folder_with_a_common_name_is_not_a_sequence_of_the_benchmark(root: Path) -> None:
    assert find(["room", "fr1/room"], root) == ["room", "fr1/room"]


def test_pattern_without_match_is_error(root: Path) -> None:
    for pattern in ("walks_*", "fr4/*", "walk_note*", str(root / "none*")):
        with pytest.raises(InputError, match="matches no sequence") as raised:
            find(["sit", pattern], root)
        assert str(raised.value).startswith(pattern) and str(root) in str(raised.value)


def test_folders_that_are_no_sequence_are_noted(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert matching_sequences(["sit", "walk_?", "fr3/*"], root).notes == []
    assert matching_sequences(["w*"], root).notes == ["w*: 1 folder is no sequence and is left out: walk_notes"]
    for name in (".git", "walk_1/rgb", "walk_2", "walk_3"):
        (root / name).mkdir(parents=True)
    monkeypatch.chdir(root)  # each folder matches as a path and as an entry of the root
    folders = "4 folders are no sequences and are left out: walk_1, walk_2, walk_3 ..."
    assert matching_sequences(["s*", "*", "walk_*"], root).notes == [f"*: {folders}", f"walk_*: {folders}"]


@pytest.mark.parametrize("pattern", [5000 * "x" + "/*", "~nobody-of-this-name/*", "a**b/*", "[" + 3 * "*" + "]"])
def test_invalid_pattern_is_an_error(pattern: str, root: Path) -> None:
    with pytest.raises(InputError, match=r"is not a valid pattern \(.*\); check the path$"):
        find([pattern], root)
