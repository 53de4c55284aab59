"""Names of the TUM sequences in all spellings."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.datasets.locate import check_name
from v3d_torch.datasets.sequence_names import (
    PAPER_SEQUENCES,
    SEQUENCES,
    canonical_name,
    download_url,
    find_paper_sequence,
    folder_label,
    short_name,
)
from v3d_torch.errors import InputError


@pytest.mark.parametrize("name", SEQUENCES)
def test_every_sequence_is_found_by_all_its_names(name: str) -> None:
    plain = name.removeprefix("rgbd_dataset_")
    short = plain.replace("freiburg", "fr")
    camera, tail = short.split("_", 1)
    for alias in (name, name.upper(), plain, short, f"{camera}/{tail}", f"tum/{camera}/{tail}", short_name(name)):
        assert canonical_name(alias) == name


@pytest.mark.parametrize(
    ("alias", "expected"),
    [
        ("fr3/w/xyz", "freiburg3_walking_xyz"),
        ("fr3_w_xyz", "freiburg3_walking_xyz"),
        ("walking_xyz", "freiburg3_walking_xyz"),
        ("w/half", "freiburg3_walking_halfsphere"),
        (" FR3/s/half ", "freiburg3_sitting_halfsphere"),
        ("fr3-sitting-static", "freiburg3_sitting_static"),
        ("fr3/office", "freiburg3_long_office_household"),
        ("fr3/long_office_validation", "freiburg3_long_office_household_validation"),
        ("fr3/nstr_tex_near", "freiburg3_nostructure_texture_near_withloop"),
        ("fr3/str_ntex_far", "freiburg3_structure_notexture_far"),
        ("fr2/person", "freiburg2_desk_with_person"),
        ("fr3/w/rpy_val", "freiburg3_walking_rpy_validation"),
    ],
)
def test_abbreviated_name_gives_full_name(alias: str, expected: str) -> None:
    assert canonical_name(alias) == f"rgbd_dataset_{expected}"


@pytest.mark.parametrize(
    "name", ["", "fr3", "xyz", "desk", "fr4/xyz", "fr3/desk", "fr1/floor_validation", "val", "/", "."]
)
def test_unknown_or_ambiguous_name_gives_none(name: str) -> None:
    assert canonical_name(name) is None


@pytest.mark.parametrize(
    "name",
    ["room", "plant", "office", "floor", "cabinet", "dishes", "person", "360", "desk2", "tum/room", "large_loop"],
)
def test_common_name_without_camera_is_not_a_sequence(name: str) -> None:
    assert canonical_name(name) is None and short_name(name) == name


def test_only_a_folder_with_the_camera_in_its_name_is_renamed() -> None:
    for folder in ("room", "walking_xyz", "s_static", "fr1", "my_fr1_room", "afr3"):
        assert folder_label(folder) == folder
    for folder in ("rgbd_dataset_freiburg3_walking_xyz", "fr3_w_xyz", "FR3-walking-xyz", "freiburg_3_walking_xyz"):
        assert folder_label(folder) == "fr3/w/xyz"


@given(st.text(st.characters(exclude_categories=["Cs"]), max_size=30))  # the default alphabet takes seconds to compute
def test_any_text_gives_a_full_name_or_none(text: str) -> None:
    assert canonical_name(text) in (None, *SEQUENCES)


def test_paper_sequences_have_the_short_names_of_its_tables() -> None:
    short = [short_name(name) for name in PAPER_SEQUENCES]
    assert short == [f"fr3/{p}/{m}" for p in "sw" for m in ("xyz", "half", "static", "rpy")]
    assert short_name("walkers_desk") == "walkers_desk"
    assert len(set(SEQUENCES)) == len(SEQUENCES) == 80


@pytest.mark.parametrize(
    ("name", "sequence"),
    [
        ("fr3/w/xyz", "fr3/w/xyz"),
        ("walking_half", "fr3/w/half"),
        ("fr3_sit_static.txt", "fr3/s/static"),
        ("results/fr3_w_rpy/latest/trajectory.txt", "fr3/w/rpy"),
        ("rgbd_dataset_freiburg3_sitting_rpy_TRANSLATION_ONLY.txt", "fr3/s/rpy"),
        ("data/rgbd_dataset_freiburg3_walking_halfsphere/groundtruth.txt", "fr3/w/half"),
        ("rgbd_dataset_freiburg3_walking_xyz_validation/groundtruth.txt", None),
        ("fr3_w_xyz/fr3_s_xyz.txt", None),
        ("fr3_walking_xyz_first300", "fr3/w/xyz"),
        ("fr1_rpy", None),
        ("demo", None),
    ],
)
def test_paper_sequence_is_found_in_names_and_paths(name: str, sequence: str | None) -> None:
    assert find_paper_sequence(name) == sequence


def test_download_url_is_that_of_the_benchmark() -> None:
    base = "https://cvg.cit.tum.de/rgbd/dataset"
    assert (
        download_url("rgbd_dataset_freiburg3_walking_xyz") == f"{base}/freiburg3/rgbd_dataset_freiburg3_walking_xyz.tgz"
    )


def test_unknown_name_suggests_folders_beside_it_and_in_the_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder in ("here/kitchen", "data/corridor"):
        (tmp_path / folder).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    for name, expected in (
        ("kichen", "kitchen"),
        (f"{tmp_path}/here/kitchn", f"{tmp_path}/here/kitchen"),
        ("coridor", "corridor"),
    ):
        with pytest.raises(InputError, match=rf"did you mean {expected}( or|\?)"):
            check_name(name, tmp_path / "data")
