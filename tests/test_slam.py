"""V3DSLAM as a library: one call to make it, one call per frame, stages that can be replaced."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.differences import differences
from helpers.library_settings import default_dtype
from helpers.walk_with_loop import CAMERA as WALK_CAMERA
from helpers.walk_with_loop import CONFIG as WALK_CONFIG
from helpers.walk_with_loop import Walk, segment_red
from PIL import Image
from torch import Tensor

from v3d_torch import V3DSLAM, FrameResult, PinholeCamera, RGBDFrame
from v3d_torch.backend.back_end import BackEndResult
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence
from v3d_torch.errors import ConfigError, InputError
from v3d_torch.features.features import Features
from v3d_torch.geometry.level_frame import level_frame
from v3d_torch.geometry.se3 import invert, se3_exp
from v3d_torch.objects.depth_view import DepthView
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.objects.motion_classifier import MotionClassifier
from v3d_torch.occupancy.floor import Floor
from v3d_torch.odometry.odometry import CameraMotion, TrackedFrame
from v3d_torch.segmentation import NoSegmentation, UprightSegmenter, make_segmenter
from v3d_torch.segmentation.coco import PERSON, UNLABELLED
from v3d_torch.types import FramePose, Instances, TrackingStatus

NO_NETWORK = load_config(None, ("segmentation.source=none",))


def test_call_returns_pose_status_and_objects_of_the_frame(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    for index in range(3):
        result = slam(demo[index])
        assert isinstance(result, FrameResult)
        assert result.stamp == float(demo.stamps[index])
        assert result.T_wc.shape == (4, 4) and result.T_wc.dtype == torch.float64
        assert torch.equal(result.T_wc, invert(slam.poses.T_cw))
        assert result.status is TrackingStatus.TRACKED
        assert result.static_mask.shape == (480, 640) and result.objects == []


def test_frames_with_and_without_a_camera_give_the_same_poses(demo: RGBDSequence) -> None:
    first, second = (V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK) for _ in range(2))
    for index in range(3):
        with_camera = replace(demo[index], camera=demo.camera)
        without_camera = replace(demo[index], camera=None)
        assert torch.equal(first(with_camera).T_wc, second(without_camera).T_wc)


def test_segmenter_of_the_config_equals_the_same_segmenter_as_an_argument(demo: RGBDSequence) -> None:
    configured, passed = V3DSLAM(demo.camera, config=NO_NETWORK), V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    for index in range(3):
        assert torch.equal(configured(demo[index]).T_wc, passed(demo[index]).T_wc)


def test_segmenter_that_is_an_empty_list_is_used(demo: RGBDSequence) -> None:
    class Recorder(list[int]):
        def __call__(self, frame: RGBDFrame) -> Instances:
            self.append(frame.index)
            return Instances.empty(*frame.image.shape[1:])

    recorder = Recorder()
    V3DSLAM(demo.camera, recorder)(demo[0])
    assert recorder == [0]


def test_moving_regions_become_objects_without_a_network(demo: RGBDSequence) -> None:
    """The baseline has no objects; a configuration with a network proposes regions also if no instance is found."""
    proposing, baseline = V3DSLAM(demo.camera, NoSegmentation()), V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    for index in range(40, 56):  # a person walks through the image
        result = proposing(demo[index])
        assert baseline(demo[index]).objects == []
    assert result.objects and all(each.label == UNLABELLED for each in result.objects)


def test_baseline_calls_object_stages_only_if_they_are_replaced_or_have_hooks(demo: RGBDSequence) -> None:
    plain, hooked, replaced = (V3DSLAM(demo.camera, config=NO_NETWORK) for _ in range(3))
    names: list[str] = []
    hooked.register_stage_hook("classify_motion", lambda name, *_: names.append(name))
    classify = replaced.classify_motion

    class LeftHalf(MotionClassifier):
        def __call__(self, *args: Any, **kwargs: Any) -> FrameObjects:
            objects = classify(*args, **kwargs)
            return replace(objects, static_mask=objects.static_mask & (torch.arange(demo.camera.width) < 320))

    replaced.classify_motion = LeftHalf(replaced.config.objects, demo.camera)
    for index in range(3):
        results = [slam(demo[index]) for slam in (plain, hooked, replaced)]
        assert torch.equal(results[0].T_wc, results[1].T_wc)
        assert bool(results[0].static_mask.all()) and bool(results[0].map_mask.all())
        assert float(results[2].static_mask.float().mean()) == 0.5
    assert names == ["classify_motion"] * 3
    assert {"free_space", "clouds", "objects"}.isdisjoint(plain.timer.times) and "objects" in hooked.timer.times


@pytest.mark.parametrize("source", ["yolo", "masks", "none"])
def test_default_dtype_of_the_program_does_not_change_the_results(
    source: str, demo: RGBDSequence, tmp_path: Path
) -> None:
    """Also in a frame without segmentation, whose instances are those of the frame before."""
    ids = np.zeros((480, 640), np.uint8)
    ids[100:300, 200:300] = 1
    for index in range(2):
        Image.fromarray(ids).save(tmp_path / f"{float(demo.stamps[index]):.6f}.png")
    config = load_config(None, (f"segmentation.source={source}", "segmentation.interval=2"))

    def track() -> list[FrameResult]:
        segment = make_segmenter(config, demo.camera, masks_dir=tmp_path if source == "masks" else None)
        slam = V3DSLAM(demo.camera, segment, config)
        return [slam(demo[index]) for index in range(2)]

    expected = track()
    with default_dtype(torch.float64):
        found = track()
    assert list(differences(expected, found, "results", {})) == []


def test_frames_from_opencv_arrays_give_the_same_poses(demo: RGBDSequence) -> None:
    stored, from_arrays = V3DSLAM(demo.camera, config=NO_NETWORK), V3DSLAM(demo.camera, config=NO_NETWORK)
    for index in range(3):
        frame = demo[index]
        image = frame.image.permute(1, 2, 0).numpy()
        metres = frame.depth[0].numpy().astype(np.float64)
        metres[metres == 0] = np.nan
        made = RGBDFrame.from_arrays(index, frame.stamp, image, metres, demo.camera)
        assert torch.equal(made.image, frame.image) and torch.equal(made.depth, frame.depth)
        assert torch.equal(stored(frame).T_wc, from_arrays(made).T_wc)


def test_uncertainty_from_the_detector_equals_that_of_the_config(demo: RGBDSequence) -> None:
    noise = {
        f"tracking.{name}": 2 * getattr(NO_NETWORK.tracking, name) for name in ("pixel_sigma", "inverse_depth_sigma")
    }
    overrides = [f"{key}={value!r}" for key, value in noise.items()]
    configured = V3DSLAM(demo.camera, config=load_config(None, ("segmentation.source=none", *overrides)))
    given, unchanged = V3DSLAM(demo.camera, config=NO_NETWORK), V3DSLAM(demo.camera, config=NO_NETWORK)
    detect = given.detect_features

    def detect_uncertain(image: torch.Tensor, depth: torch.Tensor) -> Features:
        features = detect(image, depth)
        return replace(features, sigma_ratio=torch.full_like(features.uv, 2.0))

    given.detect_features = detect_uncertain
    for index in range(0, 40, 5):
        T_wc, expected, other = (slam(demo[index]).T_wc for slam in (given, configured, unchanged))
        assert torch.equal(T_wc, expected)
    assert len(given.map.keyframes) > 1 and not torch.equal(T_wc, other)
    assert bool((given.map.observations["sigma_ratio"] == 2).all())


def test_integer_depth_in_camera_units_becomes_metres(demo: RGBDSequence) -> None:
    image = torch.zeros(480, 640, 3, dtype=torch.uint8)
    units = np.full((480, 640), 5000, np.uint16)
    assert (
        RGBDFrame.from_arrays(0, 0.0, image, units, demo.camera).depth.unique().item() == 5000 / demo.camera.depth_scale
    )
    assert RGBDFrame.from_arrays(0, 0.0, image, torch.full((480, 640), -1.0)).depth.unique().item() == 0.0


def test_the_camera_corrects_depth_in_metres_and_in_its_units(demo: RGBDSequence) -> None:
    assert demo.camera.depth_scale
    image, camera = np.zeros((480, 640, 3), np.uint8), replace(demo.camera, inverse_depth_offset=0.01)
    for depth in (np.full((480, 640), 2.0), np.full((480, 640), 2 * demo.camera.depth_scale).astype(np.uint16)):
        frame = RGBDFrame.from_arrays(0, 0.0, image, depth, camera)
        assert frame.depth.unique().item() == pytest.approx(1 / (1 / 2.0 + 0.01), rel=1e-6)


@pytest.mark.parametrize(
    ("image", "depth"),
    [
        (np.zeros((48, 64), np.uint8), np.ones((48, 64))),
        (np.zeros((3, 48, 64), np.uint8), np.ones((48, 64))),
        (np.zeros((48, 64, 3), np.float32), np.ones((48, 64))),
        (np.zeros((48, 64, 3), np.uint8), np.ones((1, 48, 64))),
        (np.zeros((48, 64, 3), np.uint8), np.ones((64, 48))),
    ],
    ids=["grey", "channels first", "float colour", "depth with a channel", "depth of another size"],
)
def test_arrays_of_wrong_shape_or_type_are_rejected(image: np.ndarray, depth: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"frame 7: .*; give "):
        RGBDFrame.from_arrays(7, 0.0, image, depth)


def test_images_of_other_libraries_become_the_same_frame(demo: RGBDSequence) -> None:
    frame = demo[0]
    rgb, metres = frame.image.permute(1, 2, 0).numpy(), frame.depth[0]
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    for image, depth in (
        (bgr[..., ::-1], metres),  # an OpenCV image, reversed to RGB
        (rgb[:, ::-1][:, ::-1], metres.numpy()[:, ::-1][:, ::-1]),
        (Image.fromarray(rgb), Image.fromarray(metres.numpy())),
        (torch.from_numpy(rgb), metres.clone().requires_grad_()),  # output of a network
    ):
        made = RGBDFrame.from_arrays(0, frame.stamp, image, depth, demo.camera)
        assert torch.equal(made.image, frame.image) and torch.equal(made.depth, frame.depth)
    half = RGBDFrame.from_arrays(0, 0.0, rgb, metres.to(torch.bfloat16), demo.camera)
    torch.testing.assert_close(half.depth, frame.depth, rtol=4e-3, atol=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": None}, "the colour image is object of shape "),
        ({"image": "rgb.png"}, "the colour image is <U7 of shape "),
        ({"depth": np.ones((480, 640), bool)}, "the depth image is bool; give metres"),
        ({"depth": np.ones((480, 640), complex)}, "the depth image is complex128; give metres"),
        ({"stamp": math.nan}, "the stamp is nan; give seconds"),
        ({"stamp": None}, "the stamp is None; give seconds"),
        ({"stamp": 1_700_000_000_000}, "the stamp is 1700000000000, in another unit or wrong; give seconds"),
        ({"stamp": 1.7e18}, r"the stamp is 1\.7e\+18, in another unit or wrong; give seconds"),
        ({"depth_delay": math.inf}, "the delay is inf; give seconds"),
        ({"camera": np.eye(3)}, "the camera is a ndarray; give a PinholeCamera"),
        (
            {"camera": PinholeCamera(260.0, 260.0, 159.5, 119.5, 320, 240)},
            "has 640x480 pixels, but the camera 320x240; give the camera that took it",
        ),
    ],
)
def test_invalid_arguments_of_from_arrays_are_named(change: dict[str, object], message: str) -> None:
    arguments = {"stamp": 0.0, "image": np.zeros((480, 640, 3), np.uint8), "depth": np.ones((480, 640))} | change
    with pytest.raises(InputError, match=f"^frame 7: {message}"):
        RGBDFrame.from_arrays(7, **arguments)


def test_frames_of_another_camera_are_rejected(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, config=NO_NETWORK)
    slam(demo[0])
    with pytest.raises(InputError, match=r"^frame 1: its camera differs from that of the V3DSLAM; make one V3DSLAM"):
        slam(replace(demo[1], camera=replace(demo.camera, fx=demo.camera.fx + 1)))
    assert slam(demo[1]).status is TrackingStatus.TRACKED


def test_missing_camera_is_named() -> None:
    with pytest.raises(ConfigError, match=r"needs a PinholeCamera, got a NoneType; .* sequence\.camera"):
        V3DSLAM(None, config=NO_NETWORK)  # type: ignore[arg-type]


@pytest.mark.parametrize("frames", [0, 1], ids=["before the first frame", "between two frames"])
def test_replaced_stage_is_called(demo: RGBDSequence, frames: int) -> None:
    slam = V3DSLAM(demo.camera, NoSegmentation(), NO_NETWORK)
    for index in range(frames):
        slam(demo[index])
    shapes, smooth = [], slam.smooth_depth
    slam.smooth_depth = lambda depth: shapes.append(depth.shape) or smooth(depth)  # type: ignore[assignment,func-returns-value]
    slam(demo[frames])
    assert shapes == [(1, 1, 480, 640)]


def test_previous_frame_is_refined_before_a_frame_is_tracked(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, NoSegmentation())
    track_camera, refine_previous = slam.track_camera, slam.refine_previous
    calls: list[str] = []

    class Track:
        reference_keyframe = staticmethod(track_camera.reference_keyframe)

        def __call__(self, *args: Any) -> FramePose:
            calls.append("track")
            return track_camera(*args)

    def refine(previous: TrackedFrame | None, velocity: Tensor | None, *rest: Any) -> None:
        calls.append("nothing" if previous is None or velocity is None else f"refine {previous.frame.index}")
        refine_previous(previous, velocity, *rest)

    slam.track_camera, slam.refine_previous = Track(), refine
    for index in range(3):
        slam(demo[index])
    assert calls == ["nothing", "track", "refine 0", "track", "refine 1", "track"]


def test_both_images_are_simultaneous_without_time_compensation(demo: RGBDSequence) -> None:
    """The delay moved the depth of the free-space check and of the maps, although the option was off."""
    config = load_config(overrides=["rolling_shutter.enabled=false"])
    slam = V3DSLAM(demo.camera, NoSegmentation(), config)
    for index in range(3):
        result = slam(replace(demo[index], depth_delay=0.012))
    assert torch.equal(result.T_dc, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize("by_stamps", [0.012, 0.005, 0.0])
def test_free_space_is_checked_with_the_pose_at_the_time_of_the_depth_image(
    by_stamps: float, demo: RGBDSequence
) -> None:
    """The delay of the depth image is that of its timestamp and that of the camera together."""
    delay = 0.012
    camera = replace(demo.camera, depth_delay=delay - by_stamps)
    overrides = ["occupancy.enabled=true", "occupancy.interval=1"]
    slam = V3DSLAM(camera, NoSegmentation(), load_config(overrides=overrides))
    motions: list[CameraMotion] = []
    views: list[DepthView] = []
    slam.register_stage_hook("odometry", lambda name, args, motion: motions.append(motion))
    slam.register_stage_hook("free_space_check", lambda name, args, result: views.append(args[0]))
    for index in range(3):
        before = slam.poses.T_cw
        result = slam(replace(demo[index], depth_delay=by_stamps, camera=camera))
    T_dc = se3_exp(motions[-1].velocity * delay)
    assert torch.equal(result.T_dc, T_dc)
    assert float((T_dc - torch.eye(4)).abs().max()) > 1e-4  # the camera moves
    torch.testing.assert_close(views[-1].T_dw, T_dc @ motions[-1].T_cp @ before)
    stored = slam.free_space_check.state_dict()["views"][-1]
    torch.testing.assert_close(stored.T_dw, T_dc @ slam.poses.T_cw)
    assert slam.occupancy is not None
    torch.testing.assert_close(slam.occupancy.state_dict()["store"]["T_dw"][-1], T_dc @ slam.poses.T_cw)


def test_views_before_a_loss_are_compared_only_when_the_camera_is_found(demo: RGBDSequence) -> None:
    slam = V3DSLAM(demo.camera, NoSegmentation())
    track_camera, lost = slam.track_camera, (3, 4)
    compared: list[bool] = []

    class Track:
        reference_keyframe = staticmethod(track_camera.reference_keyframe)

        def __call__(self, features: Features, depth: Tensor, T_cw: Tensor, *rest: Any) -> FramePose:
            if len(compared) - 1 in lost:
                return FramePose(TrackingStatus.LOST, T_cw, torch.full((len(features),), -1))
            return track_camera(features, depth, T_cw, *rest)

    slam.track_camera = Track()
    slam.register_stage_hook("free_space_check", lambda name, args, result: compared.append(args[1]))
    statuses = [slam(demo[index]).status for index in range(7)]
    assert [index for index, status in enumerate(statuses) if status is TrackingStatus.LOST] == [*lost]
    # The pose of a frame is known if the frame before it was found; the first frame has no motion.
    assert compared == [False, True, True, True, False, False, True]


def test_objects_seen_by_a_lost_camera_move_into_the_map_when_it_is_found() -> None:
    walk, offset = Walk(), se3_exp(torch.tensor([0.3, 0.0, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64))

    def places(lost: tuple[int, ...]) -> dict[float, Tensor]:
        """Return the centroids of the person in the world frame by their times, after frame 10."""
        slam = V3DSLAM(WALK_CAMERA, UprightSegmenter(segment_red), WALK_CONFIG)
        odometry, track_camera = slam.odometry, slam.track_camera

        def guess(previous: TrackedFrame | None, current: TrackedFrame, *rest: Any) -> CameraMotion:
            motion = odometry(previous, current, *rest)
            if current.frame.index not in lost[:1]:
                return motion
            return replace(
                motion, T_cp=offset @ motion.T_cp, inlier_matches=motion.inlier_matches[:0], is_measured=False
            )

        class Track:
            reference_keyframe = staticmethod(track_camera.reference_keyframe)

            def __call__(self, features: Features, depth: Tensor, T_cw: Tensor, *rest: Any) -> FramePose:
                if len(slam.poses) in lost:
                    return FramePose(TrackingStatus.LOST, T_cw, torch.full((len(features),), -1))
                return track_camera(features, depth, T_cw, *rest)

        slam.odometry, slam.track_camera = guess, Track()
        for index in range(11):
            slam(walk[index])
        people = [track for track in slam.classify_motion._tracker.tracks if track.label == PERSON]
        return {detection.stamp: detection.centroid for track in people for detection in track.detections}

    plain, found = places(()), places((8, 9))
    assert found.keys() >= {0.8, 0.9, 1.0} and found.keys() == plain.keys()
    for stamp, centroid in found.items():
        torch.testing.assert_close(centroid, plain[stamp], rtol=0, atol=0.03)


LOOP_FRAME = 10
LOOP_CORRECTION = se3_exp(torch.tensor([0.8, 0.0, 0.4, 0.0, 0.2, 0.0], dtype=torch.float64))


def walk_with_loop(T_new_old: Tensor, *, is_measured: bool) -> tuple[V3DSLAM, FrameResult]:
    """Track frames up to one in which a loop moves the map; return its result.

    Args:
        T_new_old: Correction of the world by the loop, shape (4, 4).
        is_measured: False if the camera motion before this frame is not measured.
    """
    walk, slam = Walk(), V3DSLAM(WALK_CAMERA, UprightSegmenter(segment_red), WALK_CONFIG)
    odometry, apply = slam.odometry, slam.back_end.apply

    def interrupt(previous: TrackedFrame | None, current: TrackedFrame, *rest: Any) -> CameraMotion:
        motion = odometry(previous, current, *rest)
        is_last = current.frame.index == LOOP_FRAME
        return replace(motion, is_measured=is_measured) if is_last else motion

    def close_loop(result: BackEndResult) -> Tensor | None:
        apply(result)
        if len(slam.poses) != LOOP_FRAME:
            return None
        slam.map.move_keyframes(slam.map.T_cw @ invert(T_new_old))
        return T_new_old

    slam.odometry = interrupt
    slam.back_end.apply = close_loop  # type: ignore[method-assign]
    *_, result = [slam(walk[index]) for index in range(LOOP_FRAME + 1)]
    assert result.status is TrackingStatus.TRACKED
    return slam, result


def test_loop_closed_after_an_unmeasured_motion_corrects_objects_once() -> None:
    def places(T_new_old: Tensor) -> dict[float, Tensor]:
        """Return the centroids of the person by their times."""
        slam, _ = walk_with_loop(T_new_old, is_measured=False)
        people = [track for track in slam.classify_motion._tracker.tracks if track.label == PERSON]
        return {detection.stamp: detection.centroid for track in people for detection in track.detections}

    plain, corrected = places(torch.eye(4, dtype=torch.float64)), places(LOOP_CORRECTION)
    assert corrected.keys() >= {0.9, 1.0} and corrected.keys() == plain.keys()
    for stamp, centroid in corrected.items():
        expected = LOOP_CORRECTION[:3, :3] @ plain[stamp] + LOOP_CORRECTION[:3, 3]
        torch.testing.assert_close(centroid, expected, rtol=0, atol=0.01)


@pytest.mark.parametrize("is_measured", [True, False])
def test_objects_of_a_frame_that_corrects_the_world_are_in_the_world_of_its_pose(is_measured: bool) -> None:
    def places(T_new_old: Tensor) -> list[Tensor]:
        """Return position, velocity, earlier positions and cloud of the person in the frame of the camera."""
        _, result = walk_with_loop(T_new_old, is_measured=is_measured)
        (person,) = [each for each in result.objects if each.label == PERSON]
        R, t = invert(result.T_wc)[:3, :3], invert(result.T_wc)[:3, 3]
        points = [person.state.position, *(state.position for state in person.history), *person.cloud.double()]
        return [torch.stack(points) @ R.T + t, R @ person.state.velocity]

    plain, corrected = places(torch.eye(4, dtype=torch.float64)), places(LOOP_CORRECTION)
    torch.testing.assert_close(corrected[0], plain[0], rtol=0, atol=0.01)
    torch.testing.assert_close(corrected[1], plain[1], rtol=0, atol=0.1)


def test_array_instead_of_a_frame_is_rejected(demo: RGBDSequence) -> None:
    with pytest.raises(InputError, match=r"expected an RGBDFrame, got a ndarray; RGBDFrame\.from_arrays makes frames"):
        V3DSLAM(demo.camera, config=NO_NETWORK)(np.zeros((480, 640, 3), np.uint8))


def test_compaction_of_the_map_leaves_poses_and_landmarks_identical(
    demo: RGBDSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compaction removes unused landmarks and renumbers the others; nothing else changes."""
    runs = {}
    for name, max_ratio in (("never", math.inf), ("with every keyframe", 0)):
        monkeypatch.setattr("v3d_torch.mapping.landmark_ids._COMPACTION_RATIO", max_ratio)
        slam = V3DSLAM(demo.camera, config=load_config(None, ("segmentation.source=none",)))
        for index in range(0, 120, 4):
            slam(demo[index])
        slam.flush()
        runs[name] = slam
    compacted, full = runs["with every keyframe"].map, runs["never"].map
    assert len(compacted.keyframes) == len(full.keyframes) > 3
    assert len(compacted.landmarks) < 0.9 * len(full.landmarks)
    assert torch.equal(*(slam.poses.trajectory().T_wc for slam in runs.values()))
    for name, column in compacted.landmarks.columns.items():
        assert torch.equal(column[compacted.landmarks["active"]], full.landmarks[name][full.landmarks["active"]])
    observed_points = [each.landmarks["point"][each.observations["landmark"]] for each in (compacted, full)]
    assert torch.equal(*observed_points)


def test_gravity_of_the_first_frame_is_that_of_the_world(demo: RGBDSequence) -> None:
    down = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    slam, without = V3DSLAM(demo.camera, config=NO_NETWORK), V3DSLAM(demo.camera, config=NO_NETWORK)
    for index in range(3):
        frame = replace(demo[index], gravity=down if index == 0 else -down)  # later ones are not needed
        assert torch.equal(slam(frame).T_wc, without(demo[index]).T_wc)
    assert slam.gravity is not None and without.gravity is None
    torch.testing.assert_close(slam.gravity, down)
    assert slam.T_lw is not None and without.T_lw is None
    torch.testing.assert_close(slam.T_lw[:3, :3] @ down, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64))
    restored = V3DSLAM(demo.camera, config=NO_NETWORK)
    restored.load_state_dict(slam.state_dict())
    assert restored.gravity is not None and torch.equal(restored.gravity, down)


def test_gravity_of_a_lost_frame_is_not_that_of_the_world(demo: RGBDSequence) -> None:
    slam, down = V3DSLAM(demo.camera, config=NO_NETWORK), torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    slam(demo[0])
    dark = replace(demo[1], image=torch.zeros_like(demo[1].image), gravity=-down)
    assert slam(dark).status is TrackingStatus.LOST and slam.gravity is None
    result = slam(replace(demo[2], gravity=down))
    assert result.status.is_localised and slam.gravity is not None
    torch.testing.assert_close(slam.gravity, result.T_wc[:3, :3] @ down)


def test_rejected_frame_changes_nothing(demo: RGBDSequence) -> None:
    segmented: list[int] = []

    def segment(frame: RGBDFrame) -> Instances:
        segmented.append(frame.index)
        return Instances.empty(480, 640)

    slam = V3DSLAM(demo.camera, segment, load_config(None, ("prefetch=false",)))
    for index in range(2):
        slam(demo[index])
    before = [prediction.stamp for prediction in slam.predictions if prediction is not None]
    for index in (0, 1):
        with pytest.raises(InputError, match="that of the previous frame"):
            slam(demo[index])
    assert segmented == [0, 1]
    assert [prediction.stamp for prediction in slam.predictions if prediction is not None] == before


def test_level_frame_is_that_of_the_floor_without_gravity(demo: RGBDSequence) -> None:
    config = load_config(None, ("segmentation.source=none", "occupancy.enabled=true"))
    slam = V3DSLAM(demo.camera, config=config)
    assert slam.occupancy is not None and slam.T_lw is None
    up = torch.tensor([0.0, -0.8, -0.6], dtype=torch.float64)
    slam.occupancy.floor = Floor(up, -1.2, 3.0)
    assert slam.T_lw is not None and torch.equal(slam.T_lw, level_frame(up))
    restored = V3DSLAM(demo.camera, config=config)
    restored.load_state_dict(slam.state_dict())
    assert restored.T_lw is not None and torch.equal(restored.T_lw, slam.T_lw)


def test_gravity_from_arrays_is_normalised_and_checked(demo: RGBDSequence) -> None:
    image, depth = np.zeros((480, 640, 3), np.uint8), np.ones((480, 640))
    frame = RGBDFrame.from_arrays(0, 0.0, image, depth, gravity=np.array([0, 9.8, 0]))
    assert frame.gravity is not None and frame.gravity.tolist() == [0, 1, 0]
    for wrong in (np.zeros(3), np.ones(2), np.array([np.nan, 0, 1])):
        with pytest.raises(InputError, match=r"frame 0: the gravity is .*; give a vector of 3 numbers, not zero"):
            RGBDFrame.from_arrays(0, 0.0, image, depth, gravity=wrong)
    with pytest.raises(InputError, match=r"frame 0: the gravity is .*; give a unit vector in the camera frame"):
        V3DSLAM(demo.camera, config=NO_NETWORK)(replace(demo[0], gravity=torch.ones(3, dtype=torch.float64)))


def test_state_without_a_part_is_an_error_that_names_it(demo: RGBDSequence) -> None:
    mapping = load_config(None, ("segmentation.source=none", "occupancy.enabled=true"))
    plain, with_occupancy = V3DSLAM(demo.camera, config=NO_NETWORK), V3DSLAM(demo.camera, config=mapping)
    plain(demo[0])
    with pytest.raises(ConfigError, match=r"^the state lacks occupancy; load it with the configuration of its system$"):
        with_occupancy.load_state_dict(plain.state_dict())
    assert len(with_occupancy.poses) == 0
    with pytest.raises(ConfigError, match=r"^the state lacks back_end, .*, up_estimator; load it with"):
        plain.load_state_dict({})
    with pytest.raises(ConfigError, match=r"^the state has occupancy; load it with the configuration of its system$"):
        plain.load_state_dict(with_occupancy.state_dict())
    other = V3DSLAM(replace(plain.camera, fx=2 * plain.camera.fx), plain.segment, plain.config)
    with pytest.raises(ConfigError, match=r"^the state is of another camera; load it into a system with the camera of"):
        other.load_state_dict(plain.state_dict())
    assert len(plain.poses) == 1
