"""Map files: round trip, and errors for damaged, foreign and incompatible files."""

from __future__ import annotations

import copy
import json
import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import long_wall
from helpers.unpickled_code import CreatesFile

from v3d_torch.config.loading import load_config
from v3d_torch.errors import InputError, OutputError
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import se3_exp
from v3d_torch.mapping.covisibility import covisibility_edges
from v3d_torch.mapping.keyframe import Loop
from v3d_torch.mapping.map_columns import to_columns
from v3d_torch.mapping.map_io import StoredMap, load_map, save_map
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.odometry.rolling_shutter import GLOBAL_SHUTTER, Readout
from v3d_torch.slam import V3DSLAM

CONFIG = load_config(overrides=["segmentation.source=none"])
CAMERA = replace(long_wall.CAMERA, readout=None)


def random_map(keyframes: int = 4, seed: int = 0) -> StoredMap:
    """A consistent map of random numbers, with a loop, removed observations, an inactive landmark and views."""
    generator = torch.Generator().manual_seed(seed)
    sparse_map, views = SparseMap(CONFIG.mapping, CONFIG.features, CAMERA), StaticViews(CAMERA, CONFIG.dense_map.stride)
    for index in range(keyframes):
        count = 20 * index  # the first keyframe has no features
        uv = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor([319, 239])
        features = Features(
            uv=uv,
            pixel=uv.round().long(),
            depth=1 + torch.rand(count, generator=generator, dtype=torch.float64),
            octave=torch.randint(0, 8, (count,), generator=generator),
            descriptors=torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8),
            sigma_ratio=0.5 + torch.rand(count, 2, generator=generator, dtype=torch.float64),
        )
        landmarks = torch.full((count,), -1)
        matched = min(len(sparse_map.landmarks), count // 2)
        landmarks[:matched] = torch.arange(matched)
        T_cw = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))
        keyframe = sparse_map.insert_keyframe(7 * index, 0.7 * index, T_cw, features, landmarks)
        keyframe.part = index if index >= 2 else 0
        image = torch.randint(0, 256, (3, 240, 320), generator=generator, dtype=torch.uint8)
        depth = 5 * torch.rand(1, 240, 320, generator=generator)
        views.add(keyframe, image, depth, torch.rand(240, 320, generator=generator) > 0.5)
    if keyframes > 2:
        sparse_map.remove_observations(torch.tensor([1, 5]))
        sparse_map.landmarks["active"][3] = False
        sparse_map.loops.append(Loop(0, 2, se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))))
    sparse_map.readout = Readout(0.021, 3e6)
    return StoredMap(sparse_map, views)


def assert_same(a: StoredMap, b: StoredMap) -> None:
    first, second = to_columns(a.map, a.views), to_columns(b.map, b.views)
    assert first.keys() == second.keys()
    for name, column in first.items():
        assert column.dtype == second[name].dtype, name
        assert torch.equal(column, second[name]), name


def write_map(tmp_path: Path, stored: StoredMap) -> Path:
    """Write a map to room.map in the folder, and return its path."""
    save_map(tmp_path / "room.map", stored.map, stored.views)
    return tmp_path / "room.map"


# --- round trip


def test_landmarks_that_are_not_in_use_are_not_saved(tmp_path: Path) -> None:
    stored = random_map()
    count, unused = len(stored.map.landmarks), torch.tensor([2, 17])
    observed = torch.isin(stored.map.observations["landmark"], unused)
    stored.map.remove_observations(torch.nonzero(observed)[:, 0])
    stored.map.observations.keep_rows(~observed)
    stored.map.landmarks["active"][unused] = False
    before = copy.deepcopy(stored.map.landmarks.columns)
    loaded = load_map(write_map(tmp_path, stored), CAMERA, CONFIG).map
    assert len(loaded.landmarks) == count - 2 and not loaded.landmarks["active"].all()
    for tables in (stored.map, loaded):
        assert torch.equal(tables.observations["valid"], stored.map.observations["valid"])
        points = tables.landmarks["point"][tables.observations["landmark"]]
        assert torch.equal(points, before["point"][stored.map.observations["landmark"]])
    for own, other in zip(stored.map.keyframes, loaded.keyframes, strict=True):
        assert torch.equal(own.landmarks < 0, other.landmarks < 0)
        points = loaded.landmarks["point"][other.observed_landmarks]
        assert torch.equal(points, before["point"][own.observed_landmarks])
    assert all(torch.equal(column, before[name]) for name, column in stored.map.landmarks.columns.items())


@pytest.mark.parametrize("keyframes", [0, 1, 4])
def test_loaded_map_equals_the_saved_map(keyframes: int, tmp_path: Path) -> None:
    stored = random_map(keyframes)
    loaded = load_map(write_map(tmp_path, stored), CAMERA, CONFIG)
    assert_same(stored, loaded)
    for before, after in zip(stored.map.keyframes, loaded.map.keyframes, strict=True):
        assert (after.index, after.stamp, after.part) == (before.index, before.stamp, before.part)
        assert after.frame == -1 and after.is_from_earlier_run and not before.is_from_earlier_run
        assert torch.equal(after.landmarks, before.landmarks)
        for name, column in vars(before.features).items():
            assert torch.equal(getattr(after.features, name), column)
    assert loaded.views.camera == stored.views.camera
    assert loaded.map.readout == stored.map.readout
    assert [view.keyframe for view in loaded.views] == loaded.map.keyframes
    assert torch.equal(covisibility_edges(loaded.map, 1), covisibility_edges(stored.map, 1))


def test_view_of_a_culled_keyframe_is_not_saved(tmp_path: Path) -> None:
    stored = random_map()
    stored.map.keyframes[2].reference = 1  # culled after the last view was added
    loaded = load_map(write_map(tmp_path, stored), CAMERA, CONFIG)
    assert [view.keyframe.index for view in loaded.views] == [0, 1, 3]
    assert_same(stored, loaded)


def test_map_without_sigma_ratios_has_ones(tmp_path: Path) -> None:
    stored = random_map()
    for keyframe in stored.map.keyframes:
        keyframe.features = replace(keyframe.features, sigma_ratio=torch.ones_like(keyframe.features.uv))
    stored.map.observations["sigma_ratio"].fill_(1)
    path = write_map(tmp_path, stored)
    with np.load(path) as file:
        assert not [name for name in file.files if "sigma_ratio" in name]
    assert_same(stored, load_map(path, CAMERA, CONFIG))


def test_equal_maps_give_identical_files(tmp_path: Path) -> None:
    stored = random_map()
    first = write_map(tmp_path, stored).read_bytes()
    assert write_map(tmp_path, stored).read_bytes() == first
    assert write_map(tmp_path, load_map(tmp_path / "room.map", CAMERA, CONFIG)).read_bytes() == first
    assert write_map(tmp_path, random_map(seed=1)).read_bytes() != first
    assert [path.name for path in tmp_path.iterdir()] == ["room.map"]


def test_map_without_views_can_be_saved_and_loaded_with_any_stride(tmp_path: Path) -> None:
    stored = random_map()
    save_map(tmp_path / "room.map", stored.map)
    loaded = load_map(
        tmp_path / "room.map", CAMERA, load_config(overrides=["segmentation.source=none", "dense_map.stride=5"])
    )
    assert len(loaded.views) == 0
    assert_same(StoredMap(stored.map, loaded.views), loaded)


def test_something_else_than_a_map_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"room\.map: a V3DSLAM is no map; give a SparseMap, such as slam\.map$"):
        save_map(tmp_path / "room.map", V3DSLAM(CAMERA, config=CONFIG))  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_error_names_the_path_that_cannot_be_written(tmp_path: Path) -> None:
    stored = random_map(1)
    file = write_map(tmp_path, stored)
    with pytest.raises(OutputError, match=r"room\.map/room\.map: cannot be written"):
        save_map(file / "room.map", stored.map, stored.views)


# --- damaged, foreign and incompatible files


def test_missing_file_and_folder_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.map: cannot be read \(No such file"):
        load_map(tmp_path / "none.map", CAMERA, CONFIG)
    with pytest.raises(InputError, match="cannot be read"):
        load_map(tmp_path, CAMERA, CONFIG)


def test_foreign_files_are_rejected_without_unpickling(tmp_path: Path) -> None:
    exploit = np.array([CreatesFile(tmp_path / "unpickled")], dtype=object)
    np.savez(tmp_path / "objects.npz", about=exploit)
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    np.savez(tmp_path / "json.npz", about=np.frombuffer(b"[1, 2]", dtype=np.uint8))
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "text.txt").write_text("1 2 3\n")
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "pickled").write_bytes(pickle.dumps(CreatesFile(tmp_path / "unpickled")))
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(InputError, match=rf"{path.name}: is not a map file or is damaged"):
            load_map(path, CAMERA, CONFIG)
    assert not (tmp_path / "unpickled").exists()


def test_truncated_file_is_rejected(tmp_path: Path) -> None:
    path = write_map(tmp_path, random_map())
    whole = path.read_bytes()
    for length in (1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"room\.map: is not a map file or is damaged"):
            load_map(path, CAMERA, CONFIG)


def test_file_with_a_wrong_byte_is_rejected_or_gives_the_same_map(tmp_path: Path) -> None:
    stored = random_map(3)
    path = write_map(tmp_path, stored)
    whole = path.read_bytes()
    rejected = 0
    for offset in np.random.default_rng(0).integers(0, len(whole), 60).tolist():
        path.write_bytes(whole[:offset] + bytes([whole[offset] ^ 0x55]) + whole[offset + 1 :])
        try:
            loaded = load_map(path, CAMERA, CONFIG)
        except InputError as error:
            assert "room.map" in str(error)
            rejected += 1
        else:
            assert_same(stored, loaded)
    assert rejected > 50


def rewrite(path: Path, **changes: np.ndarray | None) -> None:
    """Replace arrays of a file, or remove them (None); a double underscore stands for the slash of a name."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    for name, array in changes.items():
        name = name.replace("__", "/")
        if array is None:
            del arrays[name]
        else:
            arrays[name] = array
    with path.open("wb") as stream:
        np.savez(stream, **arrays)


def changed_header(path: Path, **changes: object) -> np.ndarray:
    """Header of a file, with some values changed."""
    with np.load(path) as file:
        header = json.loads(file["about"].tobytes())
    return np.frombuffer(json.dumps(header | changes).encode(), dtype=np.uint8)


@pytest.mark.parametrize(
    "readout", [None, {"seconds": 3.0, "information": 1.0}, {"seconds": "long", "information": 1.0}]
)
def test_invalid_readout_is_rejected(readout: object, tmp_path: Path) -> None:
    path = write_map(tmp_path, random_map(1))
    rewrite(path, about=changed_header(path, readout=readout))
    with pytest.raises(InputError, match=r"room\.map: is not a map file or is damaged"):
        load_map(path, CAMERA, CONFIG)


@pytest.mark.parametrize(
    ("stored", "own", "enabled", "expected"),
    [
        (Readout(0.021, 3e6), None, False, GLOBAL_SHUTTER),
        (Readout(0.021, 3e6), 0.015, True, Readout(0.015, math.inf)),
        (Readout(0.021, math.inf), None, True, Readout(0.021, CONFIG.rolling_shutter.readout_sigma**-2)),
        (Readout(0.021, 3e6), None, True, Readout(0.021, 3e6)),
    ],
    ids=["disabled", "stated by the camera", "known only to the map", "estimated"],
)
def test_readout_of_a_loaded_map_is_that_of_the_run(
    stored: Readout, own: float | None, enabled: bool, expected: Readout, tmp_path: Path
) -> None:
    original = random_map().map
    original.readout = stored
    original.observations["readout_jacobian"][:] = torch.tensor([100.0, -50.0])
    path = write_map(tmp_path, StoredMap(original, StaticViews(CAMERA, CONFIG.dense_map.stride)))
    overrides = ["segmentation.source=none", f"rolling_shutter.enabled={str(enabled).lower()}"]
    loaded = load_map(path, replace(CAMERA, readout=own), load_config(overrides=overrides)).map
    assert loaded.readout == expected
    shift = (expected.seconds - stored.seconds) * original.observations["readout_jacobian"]
    torch.testing.assert_close(loaded.observations["uv"], original.observations["uv"] + shift, rtol=0, atol=1e-9)


@pytest.mark.parametrize("version", [3, 6])
def test_map_of_another_version_is_rejected_with_cause_and_fix(version: int, tmp_path: Path) -> None:
    path = write_map(tmp_path, random_map(1))
    with np.load(path) as file:
        active = file["landmark/active"]
    header = changed_header(path, version=version, camera=None)
    rewrite(path, about=header, landmark__active=None, landmark__alive=active)
    message = (
        rf"room\.map: has version {version} of the map format, but this program reads versions 4 and 5;"
        r" make the map again with --save-map, or use the program version that wrote it$"
    )
    with pytest.raises(InputError, match=message):
        load_map(path, CAMERA, CONFIG)


def test_disconnected_keyframes_of_version_4_are_one_part(tmp_path: Path) -> None:
    stored = random_map()
    path = write_map(tmp_path, stored)
    flags = np.array([keyframe.is_disconnected for keyframe in stored.map.keyframes])
    header = changed_header(path, version=4)
    rewrite(path, about=header, keyframe__part=None, keyframe__disconnected=flags)
    loaded = load_map(path, CAMERA, CONFIG)
    assert [keyframe.part for keyframe in loaded.map.keyframes] == [0, 0, 1, 1]
    for keyframe in stored.map.keyframes[2:]:
        keyframe.part = 1
    assert_same(stored, loaded)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": 261.0}, "fx 261"),
        ({"width": 640, "height": 480}, "640x480"),
        ({"distortion": (0.1, 0.0, 0.0, 0.0, 0.0)}, r"distortion \[0.1"),
    ],
)
def test_map_of_another_camera_is_rejected(changes: dict[str, float], words: str, tmp_path: Path) -> None:
    path = write_map(tmp_path, random_map(1))
    other = replace(CAMERA, **changes)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=rf"made with another camera \(fx 260.*\) than the sequence's \(.*{words}"):
        load_map(path, other, CONFIG)


def test_camera_with_rounded_intrinsics_is_accepted(tmp_path: Path) -> None:
    stored = random_map(1)
    rounded = replace(CAMERA, fx=260.004, depth_scale=1000.0)
    assert len(load_map(write_map(tmp_path, stored), rounded, CONFIG).map.keyframes) == 1


@pytest.mark.parametrize("setting", ["features.scale=1.3", "features.levels=6", "dense_map.stride=4"])
def test_map_with_other_settings_is_rejected(setting: str, tmp_path: Path) -> None:
    path = write_map(tmp_path, random_map(1))
    key = setting.split("=")[0]
    with pytest.raises(InputError, match=rf"room\.map: was made with {key}=.*add --set {key}="):
        load_map(path, CAMERA, load_config(overrides=["segmentation.source=none", setting]))


@pytest.mark.parametrize(
    ("name", "row", "value"),
    [
        ("observation/landmark", 0, 10**6),
        ("observation/keyframe", 0, -1),
        ("observation/feature", 0, 20),
        ("feature/landmark", 3, -2),
        ("feature/pixel", 3, 320),
        ("feature/octave", 3, 100),
        ("feature/octave", 3, -1),
        ("observation/octave", 3, 8),
        ("feature/sigma_ratio", 3, 0.0),
        ("observation/sigma_ratio", 3, -1.0),
        ("landmark/keyframe", 2, 4),
        ("keyframe/part", 1, -1),
        ("keyframe/feature_count", 1, 19),
        ("keyframe/reference", 1, 9),
        ("keyframe/T_cw", 1, np.nan),
        ("landmark/point", 1, np.inf),
        ("loop/j", 0, 99),
        ("view/keyframe", 0, 4),
    ],
)
def test_inconsistent_values_are_rejected(name: str, row: int, value: float, tmp_path: Path) -> None:
    path = write_map(tmp_path, random_map())
    with np.load(path) as file:
        column = file[name].copy()
    column[row] = value
    rewrite(path, **{name.replace("/", "__"): column})
    with pytest.raises(InputError, match=rf"room\.map: is a damaged map file \({name}"):
        load_map(path, CAMERA, CONFIG)


@pytest.mark.parametrize(
    ("row", "column", "value"), [(slice(3), slice(3), 2.0), (0, slice(4), -1.0), (3, 1, 1e-3), (slice(4), 2, 0.0)]
)
@pytest.mark.parametrize("name", ["keyframe/T_cw", "loop/T_ij"])
def test_poses_that_are_no_rigid_motions_are_rejected(
    name: str, row: int | slice, column: int | slice, value: float, tmp_path: Path
) -> None:
    path = write_map(tmp_path, random_map())
    with np.load(path) as file:
        poses = file[name].copy()
    poses[-1, row, column] = value if value == 1e-3 else value * poses[-1, row, column]
    rewrite(path, **{name.replace("/", "__"): poses})
    with pytest.raises(InputError, match=rf"damaged map file \({name} has matrices that are not rigid motions\)"):
        load_map(path, CAMERA, CONFIG)


def test_missing_and_wrongly_typed_columns_are_rejected(tmp_path: Path) -> None:
    path = write_map(tmp_path, random_map())
    rewrite(path, landmark__found=None)
    with pytest.raises(InputError, match=r"is damaged \(.*landmark/found"):
        load_map(path, CAMERA, CONFIG)
    for wrong in (np.zeros(40, dtype=np.float32), np.zeros((40, 2), dtype=np.int64), np.zeros(3, dtype=np.int64)):
        rewrite(write_map(tmp_path, random_map()), landmark__found=wrong)
        with pytest.raises(InputError, match=r"damaged map file \(landmark/(found|visible)"):
            load_map(path, CAMERA, CONFIG)
