"""Occupancy files: round trip, identical bytes, and errors of wrong and damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.differences import differences
from helpers.occupancy_scenes import CONFIG, map_of_room

from v3d_torch.config import OccupancyConfig
from v3d_torch.errors import InputError
from v3d_torch.io.array_file import open_array_file, write_array_file
from v3d_torch.occupancy import occupancy_io
from v3d_torch.occupancy.floor import Floor
from v3d_torch.occupancy.occupancy_io import load_occupancy, save_occupancy
from v3d_torch.occupancy.occupancy_map import OccupancyMap

FLOOR = Floor(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), -1.2, 3.5)


@pytest.fixture(scope="module")
def room() -> OccupancyMap:
    return map_of_room(views=4, config=CONFIG.model_copy(update={"max_distance": 0.7}))


def test_loaded_map_answers_as_the_saved_one(room: OccupancyMap, tmp_path: Path) -> None:
    save_occupancy(tmp_path / "room.npz", room, FLOOR)
    stored = load_occupancy(tmp_path / "room.npz")
    assert stored.map.config == room.config
    points = 3 * torch.rand(500, 3, dtype=torch.float64) - 1.5
    for query in ("states", "probability", "is_free", "distance", "gradient"):
        found, expected = getattr(stored.map, query)(points), getattr(room, query)(points)
        torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)
    assert stored.floor is not None and (stored.floor.offset, stored.floor.area) == (FLOOR.offset, FLOOR.area)
    assert torch.equal(stored.floor.up, FLOOR.up)


def test_map_without_floor_and_empty_map_are_stored(tmp_path: Path) -> None:
    save_occupancy(tmp_path / "empty.npz", OccupancyMap(OccupancyConfig()))
    stored = load_occupancy(str(tmp_path / "empty.npz"))
    assert stored.floor is None and stored.map.is_empty


def test_equal_maps_give_identical_files_in_any_order_of_the_blocks(room: OccupancyMap, tmp_path: Path) -> None:
    shuffled = OccupancyMap(room.config)
    state = room.blocks.state_dict()
    shuffled.load_state_dict({name: values.flip(0) for name, values in state.items()})
    for name, occupancy in (("first", room), ("second", shuffled)):
        save_occupancy(tmp_path / name, occupancy, FLOOR)
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()


def test_missing_and_foreign_files_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.npz: cannot be read \(No such file"):
        load_occupancy(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    write_array_file(tmp_path / "other.npz", {"format": "other"}, {})
    for name in ("text.npz", "other.npz"):
        with pytest.raises(InputError, match=rf"{name}: is not an occupancy file or is damaged .*; give an occupancy"):
            load_occupancy(tmp_path / name)


def test_file_of_another_version_is_rejected(
    room: OccupancyMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(occupancy_io, "_VERSION", 99)
        save_occupancy(tmp_path / "room.npz", room)
    with pytest.raises(InputError, match=r"room\.npz: has version 99 .* reads version 1; run the sequence again"):
        load_occupancy(tmp_path / "room.npz")


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"config": {"voxel_size": -1}}, "has the configuration of another version"),
        ({"config": {"unknown": 1}}, "has the configuration of another version"),
        ({"floor": {"up": [0, 2, 0], "offset": 0, "area": 1}}, r"is damaged \(its floor is not a plane\)"),
        ({"floor": {"up": [0, 1], "offset": 0, "area": 1}}, r"is damaged \(its floor is not a plane\)"),
        ({"floor": {"up": [0, 1, 0], "offset": float("inf"), "area": 1}}, r"is damaged \(its floor is not a plane\)"),
        ({"floor": []}, r"is damaged \(list indices must be integers or slices, not str\)"),
        ({"version": None}, "has version None of the format"),
    ],
)
def test_invalid_descriptions_are_rejected(change: dict, cause: str, room: OccupancyMap, tmp_path: Path) -> None:
    path = tmp_path / "room.npz"
    save_occupancy(path, room, FLOOR)
    with open_array_file(path, "v3d_torch occupancy map", "a file", "") as file:
        about, arrays = file.about, {name: file.read(name) for name in ("coordinates", "log_odds")}
    write_array_file(path, about | change, arrays)
    with pytest.raises(InputError, match=rf"room\.npz: .*{cause}"):
        load_occupancy(path)


@pytest.mark.parametrize("damage", ["dtype", "shape", "range", "missing"])
def test_invalid_arrays_are_rejected(damage: str, room: OccupancyMap, tmp_path: Path) -> None:
    path = tmp_path / "room.npz"
    save_occupancy(path, room, FLOOR)
    with open_array_file(path, "v3d_torch occupancy map", "a file", "") as file:
        about, coordinates, log_odds = file.about, file.read("coordinates"), file.read("log_odds")
    arrays = {
        "dtype": {"coordinates": coordinates.astype(float), "log_odds": log_odds},
        "shape": {"coordinates": coordinates[:-1], "log_odds": log_odds},
        "range": {"coordinates": coordinates + 2**40, "log_odds": log_odds},
        "missing": {"coordinates": coordinates},
    }[damage]
    write_array_file(path, about, arrays)
    with pytest.raises(InputError, match=r"room\.npz: is not an occupancy file or is damaged"):
        load_occupancy(path)


def test_file_with_wrong_bytes_is_rejected_or_gives_the_same_map(room: OccupancyMap, tmp_path: Path) -> None:
    save_occupancy(tmp_path / "room.npz", room, FLOOR)
    content, generator = (tmp_path / "room.npz").read_bytes(), np.random.default_rng(0)
    rejected, count = 0, 60
    unused = 10  # the first byte of the time in the header of the first array
    for place in (unused, *generator.integers(len(content), size=count).tolist()):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(generator.integers(8))
        (tmp_path / "damaged.npz").write_bytes(damaged)
        try:
            stored = load_occupancy(tmp_path / "damaged.npz")
        except InputError:
            rejected += 1
            continue
        assert stored.map.config == room.config
        for name in ("coordinates", "log_odds"):
            found, expected = getattr(stored.map.blocks, name), getattr(room.blocks, name)
            assert torch.equal(found[stored.map.blocks.rows], expected[room.blocks.rows])
        assert list(differences(FLOOR, stored.floor, "floor", {})) == []
    assert 30 <= rejected <= count
