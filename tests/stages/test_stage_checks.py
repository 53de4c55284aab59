"""User-defined stages: their results are checked, with one sentence as error; built-in stages are not checked."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.own_stages import MODULE, write_own_stages

from v3d_torch.config import Config, StagesConfig
from v3d_torch.config.loading import load_config, override_config
from v3d_torch.errors import ConfigError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_smoother import DepthSmoother
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.odometry.odometry import Odometry
from v3d_torch.runs.numerics_check import CheckedSLAM
from v3d_torch.segmentation import make_segmenter
from v3d_torch.slam import V3DSLAM
from v3d_torch.stages.replaceable_stages import STAGES
from v3d_torch.stages.stage_checks import ReplacedStage
from v3d_torch.types import Instances, RGBDFrame

CAMERA = PinholeCamera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
IMAGE = torch.randint(0, 256, (3, 48, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
FRAMES = [RGBDFrame(index, index / 30, IMAGE, torch.ones(1, 48, 64), camera=CAMERA) for index in range(3)]
CONFIG = load_config(overrides=["segmentation.source=masks"])
"""Instances come from `segment`, so that all stages of the objects run."""


def segment(frame: RGBDFrame) -> Instances:
    mask = torch.zeros(2, 48, 64, dtype=torch.bool)
    mask[0, :, :30], mask[1, :, 35:] = True, True
    return Instances(mask, torch.tensor([0, 56]), torch.ones(2), torch.zeros(2, 4))


def make_slam(system: type[V3DSLAM] = V3DSLAM) -> V3DSLAM:
    return system(CAMERA, segment, CONFIG)


def change(**fields: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Function that changes fields of a dataclass."""
    return lambda result: replace(result, **{name: edit(getattr(result, name)) for name, edit in fields.items()})


MIRROR = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64))

WRONG: list[tuple[str, Callable[[Any], Any], str]] = [
    (
        "smooth_depth",
        lambda depth: depth[0],
        r"smooth_depth is torch.float32 of shape \(1, 48, 64\), expected a",
    ),
    ("smooth_depth", lambda depth: depth.double(), "smooth_depth is torch.float64 of shape .* torch.float32 of shape"),
    ("smooth_depth", lambda depth: depth.numpy(), r"smooth_depth is a ndarray, expected a tensor, torch.float32 of sh"),
    ("smooth_depth", lambda depth: depth.to("meta"), r"smooth_depth is .* on meta, expected a tensor"),
    ("smooth_depth", lambda depth: depth[..., ::2], r"of shape \(1, 1, 48, 32\), expected .* \(1, 1, 48, 64\)$"),
    ("smooth_depth", lambda _: None, "smooth_depth is a NoneType, expected a tensor"),
    ("detect_features", lambda _: None, "detect_features returned a NoneType; it must return Features"),
    ("detect_features", change(uv=torch.Tensor.float), r"detect_features\.uv is torch.float32 of shape \(\d+, 2\)"),
    ("detect_features", change(depth=lambda x: x[:1]), r"detect_features\.depth is .* \(1,\), expected .* \(\d\d+,\)$"),
    ("detect_features", change(sigma_ratio=lambda x: x[:, 0]), r"detect_features\.sigma_ratio .* expected .*, 2\)$"),
    (
        "detect_features",
        change(sigma_ratio=torch.zeros_like),
        r"detect_features\.sigma_ratio .* not positive and finite",
    ),
    (
        "compensate",
        change(sigma_ratio=lambda x: x / 0),
        r"compensate\.sigma_ratio has values that are not positive and",
    ),
    ("detect_features", change(descriptors=lambda x: x[:, :16]), r"detect_features\.descriptors .* shape \(\d+, 32\)"),
    ("compensate", lambda features: features[:3], r"compensate\.uv is .* \(3, 2\), expected .* shape \(\d\d+, 2\)"),
    ("odometry", lambda motion: motion.T_cp, "odometry returned a Tensor; it must return CameraMotion"),
    ("odometry", change(T_cp=lambda x: x[:3]), r"odometry\.T_cp is torch.float64 of shape \(3, 4\), .* \(4, 4\)"),
    ("odometry", change(velocity=torch.Tensor.float), r"odometry\.velocity is torch.float32 of shape \(6,\), expected"),
    (
        "odometry",
        change(inlier_matches=lambda x: x.T),
        r"odometry\.inlier_matches is torch.int64 .* expected .* of shape \(K, 2\)",
    ),
    ("odometry", change(is_measured=torch.tensor), r"odometry\.is_measured is a Tensor, expected a bool"),
    (
        "free_space_check",
        lambda result: result.was_free,
        "free_space_check returned a Tensor; it must return App",
    ),
    ("propose_unlabelled", lambda _: [], "propose_unlabelled returned a list; it must return Instances"),
    ("propose_unlabelled", change(masks=lambda x: x[..., 1:]), r"propose_unlabelled\.masks .* shape \(N, 48, 64\)"),
    (
        "propose_unlabelled",
        lambda _: Instances.from_masks(torch.ones(1, 48, 64).bool(), torch.tensor([200])),
        r"propose_unlabelled\.labels has values that are not classes of COCO or -1$",
    ),
    (
        "propose_unlabelled",
        lambda _: replace(
            Instances.from_masks(torch.ones(1, 48, 64).bool(), torch.tensor([-1])), track_ids=torch.tensor([7])
        ),
        r"propose_unlabelled\.track_ids is a Tensor, expected a NoneType$",
    ),
    ("back_project_instances", change(points=torch.Tensor.double), r"instances\.points is torch.float64 of shape \(2,"),
    ("back_project_instances", change(centroid=lambda x: x[:1]), r"\.centroid is .* \(1, 3\), expected .* \(2, 3\)"),
    ("classify_motion", lambda _: (), "classify_motion returned a tuple; it must return FrameObjects"),
    ("classify_motion", change(static_mask=torch.Tensor.byte), r"classify_motion\.static_mask is torch.uint8 of shape"),
    ("track_camera", change(T_cw=torch.Tensor.float), r"track_camera\.T_cw is torch.float32 of shape \(4, 4\)"),
    (
        "track_camera",
        change(landmarks=lambda _: torch.zeros(9999).long()),
        r"landmarks is torch.int64 of shape \(9999",
    ),
    (
        "describe_appearance",
        torch.Tensor.double,
        r"describe_appearance is torch.float64 of shape \(2, \d+\), expected a",
    ),
    ("describe_appearance", lambda x: x[:1], r"describe_appearance is .* \(1, \d+\), expected .* of shape \(2, D\)$"),
    ("estimate_state", lambda state: state.T_wc, "estimate_state returned a Tensor; it must return CameraState"),
    (
        "estimate_state",
        change(covariance=lambda x: x[:3, :3]),
        r"estimate_state\.covariance is .* \(3, 3\), .* \(6, 6\)$",
    ),
    ("track_camera", change(status=str), r"track_camera\.status is a str, expected a TrackingStatus"),
    ("smooth_depth", lambda depth: depth * torch.nan, "^smooth_depth has values that are not finite and at least 0$"),
    ("smooth_depth", torch.neg, "^smooth_depth has values that are not finite and at least 0$"),
    ("detect_features", change(uv=lambda x: x * torch.nan), r"detect_features\.uv has values that are not finite$"),
    ("detect_features", change(pixel=lambda x: x + 64), r"\.pixel has values that are not pixels of the image$"),
    ("compensate", change(pixel=lambda x: x - 64), r"\.pixel has values that are not pixels of the image$"),
    ("detect_features", change(depth=torch.neg), r"\.depth has values that are not finite and at least 0$"),
    ("detect_features", change(octave=lambda x: x - 9), r"\.octave has values that are not finite and at least 0$"),
    ("odometry", change(T_cp=lambda T: T * torch.nan), r"^odometry\.T_cp has values that are not those of a rigid tr"),
    ("odometry", change(T_cp=lambda T: T * 2), r"^odometry\.T_cp has values that are not those of a rigid transform$"),
    ("odometry", change(T_cp=lambda T: MIRROR @ T), r"\.T_cp has values that are not those of a rigid transform$"),
    ("odometry", change(matches=lambda x: x.T), r"odometry\.matches is torch.int64 .* shape \(M, 2\)"),
    ("odometry", change(matches=lambda _: torch.tensor([[0, 9999]])), r"\.matches has values that are not indices of"),
    ("odometry", change(velocity=lambda x: x / 0), r"\.velocity has values that are not finite$"),
    (
        "odometry",
        change(inlier_matches=lambda _: torch.tensor([[0, 9999]])),
        r"\.inlier_matches has values that are not indices of feat",
    ),
    (
        "odometry",
        change(inlier_matches=lambda _: torch.tensor([[-1, 0]])),
        r"\.inlier_matches has values that are not indices of featu",
    ),
    (
        "describe_appearance",
        lambda x: x * 2,
        "^describe_appearance has values that are not at least 0 with sum 1, or N",
    ),
    ("describe_appearance", lambda x: x[:, :0], "^describe_appearance has values that are not at least 0 with sum 1, "),
    ("track_camera", change(T_cw=lambda T: T / 2), r"\.T_cw has values that are not those of a rigid transform$"),
    ("track_camera", change(landmarks=lambda x: x - 9), r"\.landmarks has values that are not ids or -1$"),
    ("estimate_state", change(T_wc=lambda T: -T), r"\.T_wc has values that are not those of a rigid transform$"),
]


@pytest.mark.parametrize(("stage", "edit", "message"), WRONG)
def test_wrong_result_of_a_replaced_stage_is_named(stage: str, edit: Callable[[Any], Any], message: str) -> None:
    slam = make_slam()
    slam(FRAMES[0])
    builtin = getattr(slam, stage)

    class Own:
        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            return edit(builtin(*args, **kwargs))

        def __getattr__(self, name: str) -> Any:
            return getattr(builtin, name)

    setattr(slam, stage, Own())
    with pytest.raises(ConfigError, match=message) as caught:
        slam(FRAMES[1])
    assert "\n" not in str(caught.value)


def test_every_result_has_a_case() -> None:
    from v3d_torch.stages import stage_checks

    checked = {name for name, result in stage_checks.RESULTS.items() if result is not None}
    assert {stage for stage, _, _ in WRONG} == checked
    assert set(stage_checks.RESULTS) <= vars(make_slam()).keys()


def test_replaced_stages_that_are_right_give_the_same_results() -> None:
    slam, replaced = make_slam(), make_slam()
    for name in ("smooth_depth", "detect_features", "compensate", "odometry", "classify_motion", "track_camera"):
        setattr(replaced, name, getattr(replaced, name))
        assert isinstance(getattr(replaced, name), ReplacedStage)
    for frame in FRAMES:
        assert torch.equal(slam(frame).T_wc, replaced(frame).T_wc)
    assert replaced.state_dict().keys() == slam.state_dict().keys()


def test_built_in_stages_are_not_wrapped() -> None:
    slam = make_slam()
    assert type(slam.smooth_depth) is DepthSmoother and type(slam.odometry) is Odometry
    assert not any(isinstance(value, ReplacedStage) for value in vars(slam).values())


class ScaledDepth(torch.nn.Module):
    """Network with a parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(()))

    def forward(self, depth: torch.Tensor) -> torch.Tensor:
        return self.scale * depth


def test_stages_with_parameters_need_no_gradients_while_frames_are_processed() -> None:
    score = torch.nn.Parameter(torch.ones(()))
    learned = V3DSLAM(CAMERA, lambda frame: replace(segment(frame), scores=score.expand(2)), CONFIG)
    learned.smooth_depth = ScaledDepth()
    learned.describe_appearance = lambda image, masks: torch.ones(len(masks), 1) * score
    slam = make_slam()
    slam.smooth_depth, slam.describe_appearance = torch.nn.Identity(), lambda image, masks: torch.ones(len(masks), 1)
    for frame in FRAMES:
        found = learned(frame)
        assert torch.equal(found.T_wc, slam(frame).T_wc)
        assert not found.T_wc.requires_grad and not any(each.centroid.requires_grad for each in found.objects)
    assert learned.smooth_depth(torch.ones(1, 1, 48, 64)).requires_grad  # outside of frames, a loss can use the stage


def test_attributes_of_a_replaced_stage_are_those_of_the_stage() -> None:
    slam = make_slam()
    module = torch.nn.Identity()
    module.gain = 2.0
    slam.smooth_depth = module  # type: ignore[assignment]
    assert slam.smooth_depth.gain == 2.0 and list(slam.smooth_depth.parameters()) == []  # type: ignore[attr-defined]
    slam.smooth_depth.gain = 3.0  # type: ignore[attr-defined]
    assert module.gain == 3.0
    assert not hasattr(slam.smooth_depth, "other")


@pytest.mark.parametrize("stage", [5, None, torch.zeros(2), "smooth"])
@pytest.mark.parametrize("name", STAGES)
def test_stage_that_cannot_be_called_is_rejected_at_once(name: str, stage: Any) -> None:
    slam = make_slam()
    original = getattr(slam, name)
    with pytest.raises(ConfigError, match=f"^{name} is a .*, which cannot be called; set a stage$"):
        setattr(slam, name, stage)
    assert getattr(slam, name) is original


@pytest.mark.parametrize(
    ("stage", "message"),
    [
        (
            "classify_motion",
            "^classify_motion was replaced by a stage without correct_result; derive it from MotionCla",
        ),
        ("free_space_check", "^free_space_check was replaced by a stage without make_view; derive it from FreeSpaceCh"),
        (
            "track_camera",
            "^track_camera was replaced by a stage without reference_keyframe; derive it from",
        ),
        ("back_end", "^back_end was replaced by a stage without result; derive it from BackEnd$"),
    ],
)
@pytest.mark.parametrize("hook", [False, True])
def test_function_in_place_of_a_stage_with_methods_is_named(stage: str, message: str, hook: bool) -> None:
    slam = make_slam()
    if hook:
        slam.register_stage_hook(None, lambda *call: None)
    setattr(slam, stage, getattr(slam, stage).__call__ if stage != "back_end" else lambda: None)
    with pytest.raises(ConfigError, match=message):
        for frame in FRAMES:
            slam(frame)
            slam._apply_world_correction(torch.eye(4, dtype=torch.float64))


def test_replaced_stage_is_checked_with_numbers_too() -> None:
    slam = make_slam(CheckedSLAM)
    slam.smooth_depth = lambda depth: depth[0]  # type: ignore[assignment]
    with pytest.raises(ConfigError, match=r"smooth_depth is torch.float32 of shape"):
        slam(FRAMES[0])


@pytest.mark.parametrize("stage", ["estimate_motion", "track_map", "loop_closer"])
def test_stage_that_only_other_stages_call_cannot_be_replaced(stage: str) -> None:
    slam = make_slam()
    with pytest.raises(
        ConfigError, match=f"^{stage} cannot be replaced, because it is used inside .*; replace that instead$"
    ):
        setattr(slam, stage, getattr(slam, stage))


@pytest.mark.parametrize(
    ("name", "stage"),
    [("segmenter", "segment"), ("smooth_depht", "smooth_depth"), ("detect_feature", "detect_features")],
)
def test_misspelt_stage_is_named(name: str, stage: str) -> None:
    with pytest.raises(ConfigError, match=f"^{name} is not a stage; did you mean {stage}\\?$"):
        setattr(make_slam(), name, lambda *_: None)


def test_subclass_can_have_attributes_of_its_own() -> None:
    class OwnSLAM(V3DSLAM):
        def __init__(self) -> None:
            super().__init__(CAMERA, segment, CONFIG)
            self.robot = self.map_file = "kitchen"

    assert OwnSLAM().robot == "kitchen"


def test_class_in_place_of_a_stage_is_rejected() -> None:
    with pytest.raises(ConfigError, match=r"^smooth_depth is the class Identity; set an object of this class$"):
        make_slam().smooth_depth = torch.nn.Identity  # type: ignore[assignment]


@pytest.mark.parametrize("layer", [torch.nn.BatchNorm2d(1), torch.nn.Dropout(0.5)])
def test_network_in_training_mode_is_rejected(layer: torch.nn.Module) -> None:
    slam, network = make_slam(), torch.nn.Sequential(torch.nn.Identity(), layer.train())
    with pytest.raises(ConfigError, match=rf"^smooth_depth has layers in training mode \({type(layer).__name__}\)"):
        slam.smooth_depth = network
    slam.smooth_depth = network.eval()
    slam(FRAMES[0])


def test_every_stage_with_hooks_is_documented() -> None:
    page = (Path(__file__).parents[2] / "docs" / "your_stage.md").read_text()
    assert [name for name in STAGES if f"`{name}`" not in page] == []


def test_segmenter_that_cannot_be_called_is_rejected() -> None:
    with pytest.raises(ConfigError, match="V3DSLAM needs a segmenter, got a str; give a function that takes a frame"):
        V3DSLAM(CAMERA, "yolo", CONFIG)  # type: ignore[arg-type]


def test_segmenter_on_another_device_is_rejected() -> None:
    slam = V3DSLAM(CAMERA, lambda frame: replace(segment(frame), scores=torch.ones(2, device="meta")), CONFIG)
    with pytest.raises(ConfigError, match=r"segmenter's scores for frame 0 are torch.float32 of shape \(2,\) on meta"):
        slam(FRAMES[0])


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(write_own_stages(tmp_path))
    monkeypatch.delitem(sys.modules, MODULE, raising=False)


def configure(*overrides: str) -> Config:
    return override_config(CONFIG, overrides)


def test_configured_stages_are_checked_stages() -> None:
    from v3d_torch.stages import stage_checks

    checked = {name for name, result in stage_checks.RESULTS.items() if result is not None}
    assert StagesConfig.model_fields.keys() == checked - {"track_camera"} | {"segment"}


@pytest.mark.parametrize("system", [V3DSLAM, CheckedSLAM])
def test_configured_stage_that_does_the_same_gives_the_same_results(own: None, system: type[V3DSLAM]) -> None:
    slam, config = make_slam(system), configure(f"stages.smooth_depth={MODULE}:Outer.Same")
    configured = system(CAMERA, segment, config)
    assert isinstance(configured.smooth_depth, ReplacedStage)
    for frame in FRAMES:
        assert torch.equal(slam(frame).T_wc, configured(frame).T_wc)


def test_wrong_result_of_a_configured_stage_is_named(own: None) -> None:
    slam = V3DSLAM(CAMERA, segment, configure(f"stages.smooth_depth={MODULE}:flat"))
    with pytest.raises(ConfigError, match=r"^smooth_depth is torch.float32 of shape \(1, 48, 64\), expected a tensor"):
        slam(FRAMES[0])


def test_configured_segmenter_takes_the_place_of_the_network(own: None) -> None:
    config = load_config(overrides=[f"stages.segment={MODULE}:Corner"])
    slam = V3DSLAM(CAMERA, config=config)
    (found,) = slam(FRAMES[0]).objects
    assert found.label == 0 and slam.segment.__class__.__name__ == "Corner"
    assert V3DSLAM(CAMERA, segment, config).segment is segment  # an argument has priority


@pytest.mark.parametrize(
    ("option", "source", "arguments"),
    [
        ("segmentation.source=none", "none", {}),
        ("--masks ids", "masks", {"masks_dir": Path("ids")}),
        ("--weights a.onnx", "yolo", {"weights": Path("a.onnx")}),
    ],
)
def test_configured_segmenter_excludes_other_sources(option: str, source: str, arguments: dict[str, Path]) -> None:
    config = configure("stages.segment=lab:Segmenter", f"segmentation.source={source}")
    with pytest.raises(ConfigError, match=rf"^{option}: not used with stages.segment=lab:Segmenter; re"):
        make_segmenter(config, CAMERA, **arguments)


def test_proposals_without_pixels_are_left_out() -> None:
    slam = make_slam()
    nothing = Instances.from_masks(torch.zeros(1, 48, 64).bool(), torch.tensor([-1]))
    expected = [[each.id for each in make_slam()(FRAMES[0]).objects]]
    slam.propose_unlabelled = lambda *_: nothing
    assert [[each.id for each in slam(FRAMES[0]).objects]] == expected


def test_result_of_a_stage_can_have_further_attributes() -> None:
    @dataclass(frozen=True)
    class Marked(FrameObjects):
        mark: int = 3

    slam = make_slam()
    classify = slam.classify_motion

    class Own:
        def __call__(self, *args: Any) -> FrameObjects:
            return Marked(**vars(classify(*args)))

        def __getattr__(self, name: str) -> Any:
            return getattr(classify, name)

    slam.classify_motion = Own()
    assert slam(FRAMES[0]).static_mask.shape == (48, 64)


def test_length_of_the_vectors_of_appearance_can_change() -> None:
    """As after the built-in histograms of a loaded state."""
    slam, lengths = make_slam(), iter((3, 4, 4))

    def describe(image: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
        length = next(lengths)
        return torch.full((len(masks), length), 1 / length)

    slam.describe_appearance = describe
    ids = [[each.id for each in slam(frame).objects] for frame in FRAMES]
    assert ids[0] == ids[1] == ids[2] != []
