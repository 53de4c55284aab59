"""Maps as files: nothing is lost or changed, damage is told, and a camera is found in a map of an earlier run."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.walls import CAMERA, Slide
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.errors import InputError, OutputError
from v3d_torch.features.features import Features
from v3d_torch.geometry.se3 import invert, se3_exp, se3_log
from v3d_torch.mapping.keyframe import Loop
from v3d_torch.mapping.map_columns import to_columns
from v3d_torch.mapping.map_io import StoredMap, load_map, save_map
from v3d_torch.mapping.sparse_map import SparseMap
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.pipeline import Pipeline
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import PREFETCHED_FRAMES, V3DSLAM
from v3d_torch.types import Instances, RGBDFrame, TrackingStatus

FEW = ["segmentation.source=none", "features.count=800"]  # enough for a wall of noise, and three times as fast
CONFIG, LOCALISE = load_config(overrides=FEW), load_config(overrides=[*FEW, "mapping.enabled=false"])


def made_up(keyframes: int = 4, seed: int = 0) -> StoredMap:
    """A map of random numbers that hang together, with loops, lost observations and views."""
    generator = torch.Generator().manual_seed(seed)
    sparse_map, views = SparseMap(CONFIG.mapping, CONFIG.features, CAMERA), StaticViews(CAMERA, CONFIG.dense_map.stride)
    for index in range(keyframes):
        count = 20 * index  # the first has no feature at all
        uv = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor([319, 239])
        features = Features(
            uv=uv,
            pixel=uv.round().long(),
            depth=1 + torch.rand(count, generator=generator, dtype=torch.float64),
            octave=torch.randint(0, 8, (count,), generator=generator),
            descriptors=torch.randint(0, 256, (count, 32), generator=generator, dtype=torch.uint8),
        )
        landmarks = torch.full((count,), -1)
        known = min(len(sparse_map.landmarks), count // 2)
        landmarks[:known] = torch.arange(known)
        T_cw = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))
        keyframe = sparse_map.insert_keyframe(7 * index, 0.7 * index, T_cw, features, landmarks)
        keyframe.disconnected = index == 2
        image = torch.randint(0, 256, (3, 240, 320), generator=generator, dtype=torch.uint8)
        depth = 5 * torch.rand(1, 240, 320, generator=generator)
        views.add(keyframe, image, depth, torch.rand(240, 320, generator=generator) > 0.5)
    if keyframes > 2:
        sparse_map.remove_observations(torch.tensor([1, 5]))
        sparse_map.landmarks["alive"][3] = False
        sparse_map.loops.append(Loop(0, 2, se3_exp(torch.randn(6, generator=generator, dtype=torch.float64))))
    sparse_map.readout = Readout(0.021, 3e6)
    return StoredMap(sparse_map, views)


def assert_same(a: StoredMap, b: StoredMap) -> None:
    first, second = to_columns(a.map, a.views), to_columns(b.map, b.views)
    assert first.keys() == second.keys()
    for name, column in first.items():
        assert column.dtype == second[name].dtype, name
        assert torch.equal(column, second[name]), name


def saved(tmp_path: Path, stored: StoredMap) -> Path:
    save_map(tmp_path / "room.map", stored.map, stored.views)
    return tmp_path / "room.map"


# --- to and fro


@pytest.mark.parametrize("keyframes", [0, 1, 4])
def test_what_is_read_is_what_was_written(keyframes: int, tmp_path: Path) -> None:
    stored = made_up(keyframes)
    again = load_map(saved(tmp_path, stored), CAMERA, CONFIG)
    assert_same(stored, again)
    for before, after in zip(stored.map.keyframes, again.map.keyframes, strict=True):
        assert (after.index, after.stamp, after.disconnected) == (before.index, before.stamp, before.disconnected)
        assert after.frame == -1 and after.is_from_earlier_run and not before.is_from_earlier_run
        assert torch.equal(after.landmarks, before.landmarks)
        for name, column in vars(before.features).items():
            assert torch.equal(getattr(after.features, name), column)
    assert again.views.camera == stored.views.camera
    assert again.map.readout == stored.map.readout
    assert [view.keyframe for view in again.views] == again.map.keyframes
    assert torch.equal(again.map.covisibility_edges(1), stored.map.covisibility_edges(1))


def test_the_same_map_makes_the_same_bytes(tmp_path: Path) -> None:
    stored = made_up()
    first = saved(tmp_path, stored).read_bytes()
    assert saved(tmp_path, stored).read_bytes() == first
    assert saved(tmp_path, load_map(tmp_path / "room.map", CAMERA, CONFIG)).read_bytes() == first
    assert saved(tmp_path, made_up(seed=1)).read_bytes() != first
    assert [path.name for path in tmp_path.iterdir()] == ["room.map"]


def test_a_map_can_be_saved_without_views(tmp_path: Path) -> None:
    stored = made_up()
    save_map(tmp_path / "room.map", stored.map)
    again = load_map(tmp_path / "room.map", CAMERA, load_config(overrides=[*FEW, "dense_map.stride=5"]))
    assert len(again.views) == 0
    assert_same(StoredMap(stored.map, again.views), again)


def test_a_map_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    stored = made_up(1)
    with pytest.raises(OutputError, match=r"room\.map: cannot be written"):
        save_map(tmp_path / "room.map" / "room.map", stored.map, stored.views) if saved(tmp_path, stored) else None


# --- what is no map, or another


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.map: cannot be read \(No such file"):
        load_map(tmp_path / "none.map", CAMERA, CONFIG)
    with pytest.raises(InputError, match="cannot be read"):
        load_map(tmp_path, CAMERA, CONFIG)


class Exploit:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (self.path,))


def test_files_of_another_kind(tmp_path: Path) -> None:
    trap = np.array([Exploit(tmp_path / "sprung")], dtype=object)
    np.savez(tmp_path / "objects.npz", about=trap)
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    np.savez(tmp_path / "json.npz", about=np.frombuffer(b"[1, 2]", dtype=np.uint8))
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "text.txt").write_text("1 2 3\n")
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "pickled").write_bytes(pickle.dumps(Exploit(tmp_path / "sprung")))
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(InputError, match=rf"{path.name}: is no map"):
            load_map(path, CAMERA, CONFIG)
    assert not (tmp_path / "sprung").exists()


def test_a_truncated_file(tmp_path: Path) -> None:
    path = saved(tmp_path, made_up())
    whole = path.read_bytes()
    for length in (1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"room\.map: is no map, or a damaged one"):
            load_map(path, CAMERA, CONFIG)


def test_a_damaged_file_is_refused_or_was_damaged_where_it_does_not_matter(tmp_path: Path) -> None:
    stored = made_up(3)
    path = saved(tmp_path, stored)
    whole = path.read_bytes()
    refused = 0
    for place in np.random.default_rng(0).integers(0, len(whole), 60).tolist():
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        try:
            again = load_map(path, CAMERA, CONFIG)
        except InputError as error:
            assert "room.map" in str(error)
            refused += 1
        else:
            assert_same(stored, again)
    assert refused > 50


def rewritten(path: Path, **changes: np.ndarray | None) -> None:
    """Replace arrays of a file, or take them out."""
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


def about(path: Path, **changes: object) -> np.ndarray:
    with np.load(path) as file:
        said = json.loads(file["about"].tobytes())
    return np.frombuffer(json.dumps(said | changes).encode(), dtype=np.uint8)


@pytest.mark.parametrize(
    "readout", [None, {"seconds": 3.0, "information": 1.0}, {"seconds": "long", "information": 1.0}]
)
def test_a_map_of_no_camera(readout: object, tmp_path: Path) -> None:
    path = saved(tmp_path, made_up(1))
    rewritten(path, about=about(path, readout=readout))
    with pytest.raises(InputError, match=r"room\.map: is no map, or a damaged one"):
        load_map(path, CAMERA, CONFIG)


def test_a_map_of_another_version(tmp_path: Path) -> None:
    path = saved(tmp_path, made_up(1))
    rewritten(path, about=about(path, version=4, camera=None))
    with pytest.raises(InputError, match=r"room\.map: is a map in version 4 of its format.* knows version 3"):
        load_map(path, CAMERA, CONFIG)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": 261.0}, "fx 261"),
        ({"width": 640, "height": 480}, "640x480"),
        ({"distortion": (0.1, 0.0, 0.0, 0.0, 0.0)}, r"distortion \[0.1"),
    ],
)
def test_a_map_of_another_camera(changes: dict[str, float], words: str, tmp_path: Path) -> None:
    path = saved(tmp_path, made_up(1))
    other = replace(CAMERA, **changes)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=rf"made with another camera \(fx 260.*\) than the sequence's \(.*{words}"):
        load_map(path, other, CONFIG)


def test_a_camera_file_may_have_fewer_digits(tmp_path: Path) -> None:
    stored = made_up(1)
    nearly = replace(CAMERA, fx=260.004, depth_scale=1000.0)
    assert len(load_map(saved(tmp_path, stored), nearly, CONFIG).map.keyframes) == 1


@pytest.mark.parametrize("setting", ["features.scale=1.3", "features.levels=6", "dense_map.stride=4"])
def test_a_map_of_another_configuration(setting: str, tmp_path: Path) -> None:
    path = saved(tmp_path, made_up(1))
    key = setting.split("=")[0]
    with pytest.raises(InputError, match=rf"room\.map: was made with {key}=.*add --set {key}="):
        load_map(path, CAMERA, load_config(overrides=[*FEW, setting]))


@pytest.mark.parametrize(
    ("name", "row", "value"),
    [
        ("observation/landmark", 0, 10**6),
        ("observation/keyframe", 0, -1),
        ("observation/feature", 0, 20),
        ("feature/landmark", 3, -2),
        ("feature/pixel", 3, 320),
        ("landmark/keyframe", 2, 4),
        ("keyframe/features", 1, 19),
        ("keyframe/T_cw", 1, np.nan),
        ("landmark/point", 1, np.inf),
        ("loop/j", 0, 99),
        ("view/keyframe", 0, 4),
    ],
)
def test_numbers_that_do_not_hang_together(name: str, row: int, value: float, tmp_path: Path) -> None:
    path = saved(tmp_path, made_up())
    with np.load(path) as file:
        column = file[name].copy()
    column[row] = value
    rewritten(path, **{name.replace("/", "__"): column})
    with pytest.raises(InputError, match=rf"room\.map: is a damaged map \({name}"):
        load_map(path, CAMERA, CONFIG)


def test_columns_that_lack_or_are_of_another_kind(tmp_path: Path) -> None:
    path = saved(tmp_path, made_up())
    rewritten(path, landmark__found=None)
    with pytest.raises(InputError, match=r"damaged one \(.*landmark/found"):
        load_map(path, CAMERA, CONFIG)
    for wrong in (np.zeros(40, dtype=np.float32), np.zeros((40, 2), dtype=np.int64), np.zeros(3, dtype=np.int64)):
        rewritten(saved(tmp_path, made_up()), landmark__found=wrong)
        with pytest.raises(InputError, match=r"damaged map \(landmark/(found|visible)"):
            load_map(path, CAMERA, CONFIG)


# --- a camera in a map of an earlier run


def run(sequence: Slide, config: Config = CONFIG, known: StoredMap | None = None) -> Pipeline:
    slam = V3DSLAM(CAMERA, NoSegmentation(), config, None if known is None else known.map)
    pipeline = Pipeline(sequence, slam, views=None if known is None else known.views)
    assert pipeline().failure is None
    return pipeline


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Pipeline]:
    """A map of the wall from column 640 to 960 + 320, and the run that made it."""
    made = run(Slide(640, 960, step=10))
    path = tmp_path_factory.mktemp("maps") / "wall.map"
    save_map(path, made.slam.mapper.map, made.views)
    return path, made


def error_in_the_maps_world(pipeline: Pipeline, slide: Slide) -> Tensor:
    """Distance of each frame to its true place; the map's world is that of its first frame, at column 640."""
    T_wm = Slide(640, 640).T_wc[0]
    return (pipeline.slam.poses.trajectory().T_wc - invert(T_wm) @ slide.T_wc)[:, :3, 3].norm(dim=1)


def test_a_known_place_is_recognised_as_before(wall: tuple[Path, Pipeline]) -> None:
    path, made = wall
    stored = load_map(path, CAMERA, CONFIG)
    fresh = V3DSLAM(CAMERA, NoSegmentation(), CONFIG, stored.map)
    frame = Slide(800, 803, step=3)[1]
    features = fresh.detect_features(frame.image, frame.depth)
    before = made.slam.loop_closer.relocalise(features, made.slam.mapper.map)
    after = fresh.loop_closer.relocalise(features, fresh.mapper.map)
    assert before is not None and after is not None
    assert after.keyframe.index == before.keyframe.index
    assert torch.equal(after.tracking.T_cw, before.tracking.T_cw)
    assert torch.equal(after.tracking.landmarks, before.tracking.landmarks)


def test_localising_finds_every_frame_and_leaves_the_map_as_it_is(wall: tuple[Path, Pipeline], tmp_path: Path) -> None:
    path, _ = wall
    back = Slide(940, 660, step=20)
    done = run(back, LOCALISE, load_map(path, CAMERA, LOCALISE))
    assert done.slam.poses.statuses == [TrackingStatus.TRACKED] * len(back)
    assert error_in_the_maps_world(done, back).max() < 0.01
    save_map(tmp_path / "after.map", done.slam.mapper.map, done.views)
    assert (tmp_path / "after.map").read_bytes() == path.read_bytes()


def test_going_on_grows_the_map(wall: tuple[Path, Pipeline], tmp_path: Path) -> None:
    path, made = wall
    onward = Slide(900, 1260, step=12)
    done = run(onward, CONFIG, load_map(path, CAMERA, CONFIG))
    assert done.slam.poses.statuses == [TrackingStatus.TRACKED] * len(onward)
    assert error_in_the_maps_world(done, onward).max() < 0.03
    keyframes, before = done.slam.mapper.map.keyframes, len(made.slam.mapper.map.keyframes)
    assert len(keyframes) > before
    assert [keyframe.is_from_earlier_run for keyframe in keyframes] == before * [True] + (len(keyframes) - before) * [
        False
    ]
    assert [view.keyframe for view in done.views] == keyframes
    # A third run is found in what the second one added.
    save_map(tmp_path / "grown.map", done.slam.mapper.map, done.views)
    end = Slide(1200, 1270, step=10)
    third = run(end, LOCALISE, load_map(tmp_path / "grown.map", CAMERA, LOCALISE))
    assert third.slam.poses.statuses == [TrackingStatus.TRACKED] * len(end)
    assert error_in_the_maps_world(third, end).max() < 0.03


@pytest.mark.parametrize("config", [CONFIG, LOCALISE])
def test_a_run_that_begins_beside_the_map_is_put_right_when_it_comes_in(
    config: Config, wall: tuple[Path, Pipeline]
) -> None:
    path, _ = wall
    into = Slide(100, 760, step=15)
    done = run(into, config, load_map(path, CAMERA, config))
    statuses = done.slam.poses.statuses
    found = statuses.index(TrackingStatus.TRACKED)
    assert 10 < found < 35
    assert statuses == [TrackingStatus.ODOMETRY] * found + [TrackingStatus.TRACKED] * (len(into) - found)
    error = error_in_the_maps_world(done, into)
    assert error[-10:].max() < 0.01
    assert error.max() < 0.1  # over 3 m of the wall, by odometry


def test_a_lost_camera_does_not_turn_by_what_is_taken_for_its_shutter(wall: tuple[Path, Pipeline]) -> None:
    """Images of one velocity are bent alike: each step is right, also where the readout is wrong, as it is here."""
    path, _ = wall
    rolling = replace(CAMERA, readout=0.02)
    known = load_map(path, rolling, LOCALISE).map
    known.readout = Readout(0.02, math.inf)
    slam = V3DSLAM(rolling, NoSegmentation(), LOCALISE, known)
    into = Slide(100, 760, step=15)
    for index in range(len(into)):
        slam(into[index])
    T_wc = slam.poses.trajectory().T_wc
    turned = se3_log(invert(T_wc[2]) @ T_wc[slam.poses.statuses.index(TrackingStatus.TRACKED) - 1])[3:]
    assert turned.norm() < 0.02  # 0.1 with no velocity while the camera is lost


def test_before_a_gap_in_the_motion_frames_stay_lost(wall: tuple[Path, Pipeline]) -> None:
    path, _ = wall
    into = Slide(100, 700, step=15, dark=(8,))
    done = run(into, LOCALISE, load_map(path, CAMERA, LOCALISE))
    statuses = done.slam.poses.statuses
    found = statuses.index(TrackingStatus.TRACKED)
    assert statuses[:found] == 9 * [TrackingStatus.LOST] + (found - 9) * [TrackingStatus.ODOMETRY]
    error = error_in_the_maps_world(done, into)
    assert error[9:].max() < 0.1
    assert error[:9].max() < 0.5  # a guess: the camera was taken to go on as it did


def test_in_another_room_the_camera_stays_lost_and_the_map_as_it_is(
    wall: tuple[Path, Pipeline], tmp_path: Path
) -> None:
    path, _ = wall
    elsewhere = Slide(640, 960, step=16, seed=5)
    done = run(elsewhere, CONFIG, load_map(path, CAMERA, CONFIG))
    assert done.slam.poses.statuses == [TrackingStatus.LOST] * len(elsewhere)
    assert not done.slam.poses.located
    save_map(tmp_path / "after.map", done.slam.mapper.map, done.views)
    assert (tmp_path / "after.map").read_bytes() == path.read_bytes()


def test_the_segmenter_is_told_no_pose_before_the_camera_is_found(wall: tuple[Path, Pipeline]) -> None:
    path, _ = wall
    told: list[bool] = []

    class Listening(NoSegmentation):
        def segment_with_pose(self, frame: RGBDFrame, T_cw: Tensor | None) -> Instances:
            told.append(T_cw is not None)
            return self(frame)

    slam = V3DSLAM(CAMERA, Listening(), LOCALISE, load_map(path, CAMERA, LOCALISE).map)
    for frame in Slide(400, 660, step=20):
        slam(frame)
    found = slam.poses.statuses.index(TrackingStatus.TRACKED)
    # The frames after it are looked at before it is known that this one was found.
    unknown = found + 1 + PREFETCHED_FRAMES
    assert told == unknown * [False] + (len(told) - unknown) * [True] and told[-1]
