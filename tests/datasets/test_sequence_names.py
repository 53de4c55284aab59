"""Names of the TUM sequences, in every way that they are written."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v3d_torch.datasets.sequence_names import PAPER_SEQUENCES, SEQUENCES, canonical_name, download_url, short_name


@pytest.mark.parametrize("name", SEQUENCES)
def test_every_sequence_is_known_by_all_its_names(name: str) -> None:
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
def test_short_ways_to_write_a_name(alias: str, expected: str) -> None:
    assert canonical_name(alias) == f"rgbd_dataset_{expected}"


@pytest.mark.parametrize(
    "name", ["", "fr3", "xyz", "desk", "fr4/xyz", "fr3/desk", "fr1/floor_validation", "val", "/", "."]
)
def test_what_is_no_or_not_one_name(name: str) -> None:
    assert canonical_name(name) is None


@given(st.text(max_size=30))
def test_any_text_is_a_name_or_none(text: str) -> None:
    assert canonical_name(text) in (None, *SEQUENCES)


def test_names_of_the_paper() -> None:
    short = [short_name(name) for name in PAPER_SEQUENCES]
    assert short == [f"fr3/{p}/{m}" for p in "sw" for m in ("xyz", "half", "static", "rpy")]
    assert short_name("walkers_desk") == "walkers_desk"
    assert len(set(SEQUENCES)) == len(SEQUENCES) == 80


def test_download_url() -> None:
    base = "https://cvg.cit.tum.de/rgbd/dataset"
    assert (
        download_url("rgbd_dataset_freiburg3_walking_xyz") == f"{base}/freiburg3/rgbd_dataset_freiburg3_walking_xyz.tgz"
    )
