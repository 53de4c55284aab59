"""The depth scale of sequences: stated, prescribed by the layout, or estimated and reported."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.bags import DEPTH, RGB, MessageFactory
from helpers.tiny_images import CAMERA_YAML, colour_of, save
from helpers.videos import write_video
from numpy.typing import NDArray
from PIL import Image

from v3d_torch.datasets import RGBDSequence, SourceOptions, load_sequence, open_source
from v3d_torch.datasets.image_sequence import ImageSequence
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.errors import DepthScaleWarning, InputError
from v3d_torch.geometry.camera import PinholeCamera

WIDTH, HEIGHT = 64, 48
CAMERA = f"fx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\nwidth: {WIDTH}\nheight: {HEIGHT}\n"
K = "60 0 31.5\n0 60 23.5\n0 0 1\n"
FPS = SourceOptions(fps=10)


def metres(seed: int) -> NDArray[np.float64]:
    """Depth of a room, measured in millimetres."""
    return np.random.default_rng(seed).integers(600, 4200, (HEIGHT, WIDTH)) / 1000


def units(scale: float, seed: int = 0) -> NDArray[np.uint16]:
    return np.rint(metres(seed) * scale).astype(np.uint16)


def images(folder: Path, scale: float) -> Path:
    for i in range(3):
        save(folder / "rgb" / f"{i}.png", colour_of(i, WIDTH, HEIGHT))
        save(folder / "depth" / f"{i}.png", units(scale, i))
    return folder


def tum(folder: Path, scale: float) -> Path:
    images(folder, scale)
    for kind in ("rgb", "depth"):
        (folder / f"{kind}.txt").write_text("".join(f"{i}.0 {kind}/{i}.png\n" for i in range(3)))
    return folder


def videos(folder: Path, scale: float) -> Path:
    folder.mkdir()
    write_video(folder / "rgb.avi", 10, [colour_of(i, WIDTH, HEIGHT) for i in range(3)])
    write_video(folder / "depth.mkv", 10, [units(scale, i) for i in range(3)])
    return folder


def seven_scenes(folder: Path, scale: float) -> Path:
    for i in range(3):
        save(folder / f"frame-{i:06d}.color.png", colour_of(i, WIDTH, HEIGHT))
        save(folder / f"frame-{i:06d}.depth.png", units(scale, i))
    return folder


def bag(folder: Path, scale: float) -> Path:
    make = MessageFactory("mcap")
    messages = []
    for i in range(3):
        messages.append((RGB, 1 + i / 10, make.image(1 + i / 10, "rgb8", colour_of(i, WIDTH, HEIGHT))))
        messages.append((DEPTH, 1 + i / 10, make.image(1 + i / 10, "16UC1", units(scale, i))))
    return make.write(folder, messages)


def assert_metres(sequence: RGBDSequence) -> None:
    for frame in sequence:
        np.testing.assert_allclose(frame.depth[0], metres(frame.index), rtol=1e-6)


@pytest.mark.parametrize(("make", "options"), [(images, FPS), (tum, None), (videos, None)])
@pytest.mark.parametrize("scale", [1000, 5000])
@pytest.mark.parametrize("file", ["camera.yaml", "K.txt"])
def test_depth_scale_that_is_not_stated_is_estimated_and_reported(
    tmp_path: Path, make: Callable[[Path, float], Path], options: SourceOptions | None, scale: float, file: str
) -> None:
    folder = make(tmp_path / "take", scale)
    (folder / file).write_text(CAMERA if file == "camera.yaml" else K)
    with pytest.warns(
        DepthScaleWarning, match=rf"take: depth scale {scale} \(.*\), estimated from 3 depth images with"
    ):
        sequence = load_sequence(str(folder), options=options)
    assert sequence.camera == PinholeCamera(60, 60, 31.5, 23.5, WIDTH, HEIGHT, depth_scale=scale)
    assert isinstance(sequence, ImageSequence) and "state depth_scale in camera.yaml" in str(sequence.depth_scale_note)
    assert_metres(sequence)


@pytest.mark.parametrize(
    ("make", "name", "scale"),
    [
        (seven_scenes, "seq-01", 1000),
        (bag, "take", 1000),
        (tum, "rgbd_dataset_freiburg2_xyz", 5000),
        (tum, "rgbd_bonn_crowd", 5000),
    ],
)
def test_layout_prescribes_the_depth_scale(
    tmp_path: Path, make: Callable[[Path, float], Path], name: str, scale: float
) -> None:
    """A camera without a depth scale takes that of the data set, or of ROS, whatever the images look like."""
    path = make(tmp_path / name, scale)
    (tmp_path / "K.txt").write_text(K)
    for camera in (tmp_path / "K.txt", PinholeCamera(60, 60, 31.5, 23.5, WIDTH, HEIGHT)):
        with warnings.catch_warnings(action="error"):
            sequence = load_sequence(str(path), camera=camera)
        assert sequence.camera.depth_scale == scale
        assert_metres(sequence)


def test_name_that_only_resembles_one_of_the_benchmark_prescribes_nothing(tmp_path: Path) -> None:
    folder = tum(tmp_path / "fr1_my_office", 1000)
    (folder / "K.txt").write_text(K)
    with pytest.warns(DepthScaleWarning, match="depth scale 1000"):
        assert_metres(load_sequence(str(folder)))


def test_stated_depth_scale_is_used_whatever_the_images_look_like(tmp_path: Path) -> None:
    folder = tum(tmp_path / "rgbd_dataset_freiburg2_xyz", 1000)
    (folder / "camera.yaml").write_text(CAMERA + "depth_scale: 1000\n")
    with warnings.catch_warnings(action="error"):
        assert_metres(load_sequence(str(folder)))


@pytest.mark.parametrize("make", [images, tum, videos])
def test_depth_scale_that_is_neither_stated_nor_estimated_is_an_error(
    tmp_path: Path, make: Callable[[Path, float], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    far = np.random.default_rng(0).integers(2000, 7000, (HEIGHT, WIDTH))
    monkeypatch.setitem(globals(), "metres", lambda seed: far / 1000)
    folder = make(tmp_path / "take", 1000)
    (folder / "camera.yaml").write_text(CAMERA)
    with pytest.raises(
        InputError, match="take: the unit of depth is not stated and cannot be estimated from the images"
    ) as error:
        open_source(str(folder), options=FPS if make is images else None)
    assert "write the line depth_scale: 1000 into camera.yaml" in str(error.value) and "\n" not in str(error.value)
    (folder / "camera.yaml").write_text(CAMERA + "depth_scale: 1000\n")
    assert_metres(load_sequence(str(folder), options=FPS if make is images else None))


def test_images_that_cannot_be_read_are_not_sampled(tmp_path: Path) -> None:
    folder = tum(tmp_path / "take", 1000)
    (folder / "camera.yaml").write_text(CAMERA)
    (folder / "depth" / "1.png").write_bytes(b"")
    with pytest.warns(DepthScaleWarning, match="from 2 depth images"):
        sequence = load_sequence(str(folder))
    assert sequence.camera.depth_scale == 1000
    (folder / "depth" / "0.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"depth/0.png: is not a PNG"):
        load_sequence(str(folder))


def test_recorded_sequence_states_its_depth_scale(tmp_path: Path) -> None:
    """5000 units per metre, as in the TUM benchmark, if the source has depth in floating point."""
    folder = tum(tmp_path / "take", 1000)
    for i in range(3):
        Image.fromarray(metres(i).astype(np.float32)).save(folder / "depth" / f"{i}.tiff")
    (folder / "depth.txt").write_text("".join(f"{i}.0 depth/{i}.tiff\n" for i in range(3)))
    (folder / "camera.yaml").write_text(CAMERA)
    with warnings.catch_warnings(action="error"):
        source = load_sequence(str(folder))
    assert source.camera.depth_scale is None
    with TUMWriter(tmp_path / "out", source.camera) as writer:
        for frame in source:
            writer.add(frame)
    saved = load_sequence(str(tmp_path / "out"))
    assert saved.camera.depth_scale == 5000
    assert_metres(saved)


def test_presets_and_published_cameras_state_their_depth_scale() -> None:
    from v3d_torch.datasets import bonn, icl_nuim, seven_scenes
    from v3d_torch.datasets.cameras import PRESETS, load_camera

    published = [bonn.CAMERA, icl_nuim.CAMERA, seven_scenes.CAMERA, *map(load_camera, PRESETS)]
    assert all(camera.depth_scale in (1000, 5000) for camera in published)
    assert "depth_scale: 1000" in CAMERA_YAML
