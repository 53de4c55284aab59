"""Command ``v3d-torch export``: a run with saved masks in the formats of other tools, and errors."""

from __future__ import annotations

import json
import shutil
from contextlib import chdir
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from helpers.colmap_reader import read_model
from helpers.commands import assert_error_line, files_in, invoke
from helpers.demo_frames import copy_frames

from v3d_torch.cli import export, run
from v3d_torch.datasets import load_sequence, tum_writer
from v3d_torch.datasets.tum_trajectory import read_trajectory
from v3d_torch.export import nerfstudio, posed_image
from v3d_torch.geometry.se3 import invert
from v3d_torch.io.files import write_png
from v3d_torch.io.ply import read_ply_points

FRAMES = 12


pytestmark = pytest.mark.usefixtures("no_figures")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sequence") / "walk"
    copy_frames(folder, range(45, 45 + FRAMES))
    return folder


@pytest.fixture(scope="module")
def results(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a run with masks and map, called from another folder with relative paths."""
    folder = tmp_path_factory.mktemp("run")
    shutil.copytree(sequence, folder / "walk")
    arguments = "--seq walk --segmenter masks --masks walk/masks --save-masks --save-map room.npz --out out"
    with chdir(folder):
        done = invoke(run.app, *arguments.split(), "--set", "mapping.max_keyframe_interval=4")
    assert (done.exit_code, done.stderr) == (0, "")
    return folder / "out"


@pytest.fixture(scope="module")
def colmap(results: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("colmap") / "out"
    done = call(results, "--format", "colmap", "--out", out, "--keyframes")
    assert (done.exit_code, done.stderr, done.stdout) == (
        0,
        "",
        f"{len(list((out / 'images').iterdir()))} images: {out}\n",
    )
    return out


call = partial(invoke, export.app, COLUMNS="200")


@pytest.mark.parametrize("is_new", [True, False])
@pytest.mark.parametrize("format_", ["nerfstudio", "colmap", "tum"])
def test_interrupted_export_can_be_repeated(
    format_: str, is_new: bool, results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    if not is_new:
        out.mkdir()

    def interrupt(path: Path, image: object) -> None:
        write_png(path, image)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    arguments = (results, "--format", format_, "--out", out, "--every", "6")
    with monkeypatch.context() as patch:
        for module in (nerfstudio, posed_image, tum_writer):
            patch.setattr(module, "write_png", interrupt)
        assert_error_line(call(*arguments), "interrupted before the results were written")
    assert not files_in(tmp_path) and out.exists() != is_new
    assert call(*arguments).exit_code == 0 and files_in(out)


def test_request_of_the_run_has_absolute_paths(results: Path) -> None:
    text = (results / "request.yaml").read_text()
    assert f"seq: {results.parent / 'walk'}\n" in text and f"save_map: {results.parent / 'room.npz'}\n" in text


def test_nerfstudio_export_has_all_frames_with_poses_masks_and_depth(
    results: Path, sequence: Path, tmp_path: Path
) -> None:
    done = call(results, "--format", "nerfstudio", "--out", tmp_path / "out [b]")
    assert (done.exit_code, done.stderr, done.stdout) == (0, "", f"{FRAMES} images: {tmp_path / 'out [b]'}\n")
    transforms = json.loads((tmp_path / "out [b]" / "transforms.json").read_text())
    poses, frames = read_trajectory(results / "trajectory.txt"), load_sequence(str(sequence))
    assert len(transforms["frames"]) == FRAMES
    for entry, T_wc, frame in zip(transforms["frames"], poses.T_wc, frames, strict=True):
        np.testing.assert_allclose(np.array(entry["transform_matrix"])[:3, 3], T_wc[:3, 3], atol=1e-9)
        image = cv2.imread(str(tmp_path / "out [b]" / entry["file_path"]))[..., ::-1]
        np.testing.assert_array_equal(image, frame.image.permute(1, 2, 0))
        mask = cv2.imread(str(tmp_path / "out [b]" / entry["mask_path"]), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(tmp_path / "out [b]" / entry["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        assert (depth[mask == 0] == 0).all() and (depth[mask == 255] > 0).mean() > 0.9
        people = frames.motion_mask(frame.index)
        assert people is not None and (mask[people.numpy() > 0] == 0).mean() > 0.95
    assert (tmp_path / "out [b]" / "points.ply").read_bytes() == (results / "map.ply").read_bytes()


def test_convention_map_points_have_their_colours_in_the_images_of_a_colmap_export(results: Path, colmap: Path) -> None:
    points, colours = read_ply_points(results / "map.ply")
    model = read_model(colmap / "sparse" / "0", points[::200].double().numpy())
    for name, image in model.images.items():
        picture = cv2.imread(str(colmap / "images" / name))[..., ::-1].astype(float)
        mask = cv2.imread(str(colmap / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        differences = []
        for uv, colour in zip(image["projections"], colours[::200].tolist(), strict=True):
            if uv is not None and 0 <= uv[0] < 640 and 0 <= uv[1] < 480:
                u, v = np.floor(uv).astype(int)
                if mask[v, u]:
                    differences.append(np.abs(picture[v, u] - colour).mean())
        assert len(differences) > 100 and np.median(differences) < 12


def test_colmap_landmarks_are_those_of_the_saved_map(results: Path, colmap: Path) -> None:
    model = read_model(colmap / "sparse" / "0")
    landmarks = [point for point in model.points.values() if point["track"]]
    assert len(landmarks) > 100 and all(len(point["track"]) >= 2 for point in landmarks)
    assert np.mean([point["error"] for point in landmarks]) < 1.5
    assert len(model.points) - len(landmarks) == len(read_ply_points(results / "map.ply")[0])
    T_wc = read_trajectory(results / "keyframes.txt").T_wc
    written = [image["T_cw"] for _, image in sorted(model.images.items())]
    np.testing.assert_allclose(written, invert(T_wc)[:, :3], atol=1e-7)


def test_tum_export_is_a_sequence_without_what_moves(results: Path, sequence: Path, tmp_path: Path) -> None:
    done = call(results, "--format", "tum", "--out", tmp_path / "static", "--every", "3")
    assert (done.exit_code, done.stderr, done.stdout) == (0, "", f"4 images: {tmp_path / 'static'}\n")
    original, static = load_sequence(str(sequence)), load_sequence(str(tmp_path / "static"))
    estimate = read_trajectory(tmp_path / "static" / "estimated_trajectory.txt")
    assert estimate.stamps.tolist() == static.stamps.tolist() == original.stamps.tolist()[::3]
    for frame, source in zip(static, (original[index] for index in range(0, FRAMES, 3)), strict=True):
        assert torch.equal(frame.image, source.image)
        mask = cv2.imread(str(results / "map_masks" / f"{source.stamp:.6f}.png"), cv2.IMREAD_UNCHANGED)
        assert torch.equal(frame.depth[0], torch.where(torch.from_numpy(mask == 0), source.depth[0], 0.0))
    assert static.groundtruth is not None  # of the source, in a file of its own


def test_undistort_and_no_masks(results: Path, tmp_path: Path) -> None:
    done = call(results, "--format", "nerfstudio", "--out", tmp_path, "--every", "6", "--undistort", "--no-masks")
    assert done.exit_code == 0, done.stderr
    assert len(files_in(tmp_path)) == 2 * 3 + 2
    mask = cv2.imread(str(tmp_path / "masks" / "frame_000006.png"), cv2.IMREAD_UNCHANGED)
    assert (mask == 255).all()  # the demo has no lens distortion


def test_undistort_removes_the_lens_distortion_of_images_and_camera(
    results: Path, sequence: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "walk"
    shutil.copytree(sequence, folder)
    text = (folder / "camera.yaml").read_text()
    without, coefficients = "distortion: [0.0, 0.0, 0.0, 0.0, 0.0]", (0.26, -0.95, -0.005, 0.003, 1.16)
    assert without in text
    (folder / "camera.yaml").write_text(text.replace(without, f"distortion: {list(coefficients)}"))
    for name, options in (("recorded", ()), ("straight", ("--undistort",))):
        arguments = ("--format", "nerfstudio", "--out", tmp_path / name, "--every", "6", "--seq", folder, *options)
        done = call(results, *arguments)
        assert done.exit_code == 0, done.stderr
    recorded, straight = (
        json.loads((tmp_path / name / "transforms.json").read_text()) for name in ("recorded", "straight")
    )
    lens = ("k1", "k2", "p1", "p2", "k3")
    assert tuple(recorded[name] for name in lens) == coefficients
    assert [straight[name] for name in lens] == [0.0] * 5
    assert all(straight[name] == recorded[name] for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"))
    source = load_sequence(str(folder))
    undistort = posed_image.Undistorter(source.camera)
    for index, entry in zip((0, 6), straight["frames"], strict=True):
        saved = cv2.imread(str(results / "map_masks" / f"{source[index].stamp:.6f}.png"), cv2.IMREAD_UNCHANGED)
        image = posed_image.PosedImage(source[index], torch.eye(4, dtype=torch.float64), torch.from_numpy(saved == 0))
        expected = undistort(image)
        assert not torch.equal(expected.frame.image, source[index].image)
        colour = cv2.imread(str(tmp_path / "straight" / entry["file_path"]))[..., ::-1]
        np.testing.assert_array_equal(colour, expected.frame.image.permute(1, 2, 0))
        mask = cv2.imread(str(tmp_path / "straight" / entry["mask_path"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask == 255, expected.static)


def test_moved_sequence_is_given_with_seq(results: Path, sequence: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(results, copy)
    moved = (copy / "request.yaml").read_text().replace("/walk", "/gone")
    (copy / "request.yaml").write_text(moved)
    arguments = (copy, "--format", "nerfstudio", "--every", "6", "--out")
    gone = results.with_name("gone")
    expected = f"{gone}: the sequence of the run in {copy} is not there; give its new place with --seq"
    assert_error_line(call(*arguments, tmp_path / "a"), expected)
    assert call(*arguments, tmp_path / "b", "--seq", sequence).exit_code == 0
    assert len(list((tmp_path / "b" / "images").iterdir())) == 2
    copy_frames(tmp_path / "other", range(5))
    for name, words in (("other", "fewer than the run"), ("later", "pass the sequence of this run with --seq")):
        if name == "later":
            copy_frames(tmp_path / "later", range(60, 60 + FRAMES))
        assert_error_line(call(*arguments, tmp_path / f"to_{name}", "--seq", tmp_path / name), words)


def test_other_sequence_with_the_same_timestamps_is_an_error_or_noted(
    results: Path, sequence: Path, tmp_path: Path
) -> None:
    arguments = (results, "--format", "nerfstudio", "--every", "6", "--out")
    other = tmp_path / "other"
    shutil.copytree(sequence, other)
    done = call(*arguments, tmp_path / "renamed", "--seq", other)
    assert (done.exit_code, done.stderr) == (0, "")
    assert "note: the run was of walk; check that other has the same images" in done.stdout
    (other / "groundtruth.txt").unlink()
    done = call(*arguments, tmp_path / "out", "--seq", other)
    assert_error_line(done, "other: is another sequence than walk")
    assert not (tmp_path / "out").exists()


def test_broken_frames_that_the_run_skipped_are_left_out(sequence: Path, tmp_path: Path) -> None:
    shutil.copytree(sequence, tmp_path / "walk")
    broken = sorted((tmp_path / "walk" / "rgb").iterdir())[2]
    broken.write_bytes(b"")
    arguments = f"--seq {tmp_path / 'walk'} --segmenter none --skip-broken --save-masks --out {tmp_path / 'run'}"
    assert invoke(run.app, *arguments.split()).exit_code == 0
    done = call(tmp_path / "run", "--format", "tum", "--out", tmp_path / "out")
    assert (done.exit_code, done.stderr) == (0, "")
    original, static = load_sequence(str(sequence)), load_sequence(str(tmp_path / "out"))
    assert static.stamps.tolist() == [stamp for index, stamp in enumerate(original.stamps.tolist()) if index != 2]


def test_map_without_common_landmarks_gives_a_note(results: Path, tmp_path: Path) -> None:
    arguments = ("--format", "colmap", "--out", tmp_path / "out", "--every", "11")
    copy = tmp_path / "copy"
    shutil.copytree(results, copy)
    (copy / "request.yaml").write_text((results / "request.yaml").read_text().replace("room.npz", "gone.npz"))
    done = call(copy, *arguments)
    assert done.exit_code == 0 and "note: no image points are written: " in done.stdout and "gone.npz" in done.stdout


def test_map_that_a_later_run_replaced_is_named(results: Path, sequence: Path, tmp_path: Path) -> None:
    copy, later = tmp_path / "copy", tmp_path / "room.npz"
    shutil.copytree(results, copy)
    request = (results / "request.yaml").read_text()
    (copy / "request.yaml").write_text(request.replace(str(results.with_name("room.npz")), str(later)))
    options = ("--segmenter", "none", "--set", "mapping.max_keyframe_interval=3", "--out", tmp_path / "later")
    assert invoke(run.app, "--seq", sequence, *options, "--save-map", later).exit_code == 0
    done = call(copy, "--format", "colmap", "--out", tmp_path / "out", "--keyframes")
    note = f"note: no image points are written: {later} is the map of another run; run the sequence again with"
    assert done.exit_code == 0 and note in done.stdout, done.stdout


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("map_masks", "has no masks; run the sequence again with --save-masks, or do not mask with --no-masks"),
        ("request.yaml", "request.yaml: cannot be read"),
        ("metrics.json", "has no results of a run"),
        ("map.ply", "map.ply: is missing, because the run did not end"),
    ],
)
def test_missing_file_is_an_error_and_nothing_is_written(file: str, words: str, results: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(results, copy)
    shutil.rmtree(copy / file) if (copy / file).is_dir() else (copy / file).unlink()
    assert_error_line(call(copy, "--format", "nerfstudio", "--out", tmp_path / "out"), words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("format_", ["nerfstudio", "colmap"])
def test_damaged_point_map_is_an_error_and_nothing_is_written(format_: str, results: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(results, tmp_path / "copy")
    (copy / "map.ply").write_bytes((results / "map.ply").read_bytes()[:-1000])
    done = call(copy, "--format", format_, "--out", tmp_path / "out")
    assert_error_line(done, f"{copy / 'map.ply'}: is damaged or not a point map of a run")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("can_resume", [True, False])
def test_run_that_ended_early_is_noted(can_resume: bool, results: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(results, tmp_path / "my run")
    metrics = json.loads((results / "metrics.json").read_text())
    metrics |= {"frames": 60, "failure": f"interrupted after {FRAMES} of 60 frames"}
    (copy / "metrics.json").write_text(json.dumps(metrics))
    if can_resume:
        (copy / "checkpoint.v3d").touch()
    done = call(copy, "--format", "tum", "--out", tmp_path / "out")
    fix = f"; continue it with run --resume '{copy}'" if can_resume else ""
    note = f"note: the run ended early, after {FRAMES} of 60 frames{fix}\n"
    assert (done.exit_code, done.stdout) == (0, f"{FRAMES} images: {tmp_path / 'out'}\n{note}"), done.stderr


def test_folder_in_a_suggested_command_is_quoted(results: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(results, tmp_path / "my run")
    (copy / "map.ply").unlink()
    assert_error_line(call(copy, "--format", "nerfstudio", "--out", tmp_path / "out"), f"run --resume '{copy}'")


def test_unsuitable_options_and_folders_are_errors(results: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "diary.txt").write_text("")
    done = call(results, "--format", "colmap", "--out", tmp_path / "full")
    assert_error_line(done, "already exists and is not an empty folder; choose another folder with --out")
    done = call(results, "--format", "tum", "--out", tmp_path / "out", "--no-masks")
    assert_error_line(done, "--format tum: needs masks and the recorded images; remove --no-masks and --undistort")
    for empty, name in (((results, "--out", ""), "--out"), (("", "--out", tmp_path / "out"), "an argument")):
        assert_error_line(call("--format=tum", *empty), f"{name}: is an empty path; give a path")
    copy = tmp_path / "live"
    shutil.copytree(results, copy)
    (copy / "request.yaml").write_text(
        (results / "request.yaml").read_text().replace(f"seq: {results.parent}/walk", "seq: 'realsense:'")
    )
    assert_error_line(
        call(copy, "--format", "tum", "--out", tmp_path / "out"), "images of a live camera are not stored"
    )
    (copy / "request.yaml").write_text("seq: 7\n")
    assert_error_line(call(copy, "--format", "tum", "--out", tmp_path / "out"), "request.yaml: seq: input should be")


def test_run_without_keyframes_is_exported_without_keyframes_only(results: Path, tmp_path: Path) -> None:
    """Without keyframes as after ``run --localise``."""
    copy, out = tmp_path / "copy", tmp_path / "out"
    shutil.copytree(results, copy)
    frames = pq.read_table(copy / "frames.parquet")
    none = pa.array([False] * frames.num_rows)
    pq.write_table(frames.set_column(frames.column_names.index("keyframe"), "keyframe", none), copy / "frames.parquet")
    done = call(copy, "--format", "colmap", "--out", out, "--keyframes")
    assert_error_line(done, f"{copy}: has no keyframe with a known pose; export without --keyframes")
    assert not out.exists()
    done = call(copy, "--format", "nerfstudio", "--out", out)
    assert (done.exit_code, done.stdout) == (0, f"{FRAMES} images: {out}\n")


def test_damaged_mask_is_an_error_that_names_the_file(results: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(results, copy)
    mask = sorted((copy / "map_masks").iterdir())[0]
    mask.write_bytes(b"")
    done = call(copy, "--format", "nerfstudio", "--out", tmp_path / "out")
    assert_error_line(done, str(mask), "run the sequence again with --save-masks")
