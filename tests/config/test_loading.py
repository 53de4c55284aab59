"""Loading of configurations: precedence, errors, round trip."""

from __future__ import annotations

from pathlib import Path

import pytest

import v3d_torch
from v3d_torch.config import Config
from v3d_torch.config.loading import CONFIGS, dump_config, find_config, load_config, override_config
from v3d_torch.errors import ConfigError


def test_overrides_take_precedence_over_the_file_and_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("seed: 3\nobjects:\n  voting:\n    vote_threshold: 4\n    distance_threshold: 0.1\n")
    config = load_config(file, ["objects.voting.distance_threshold=0.05"])
    assert (config.seed, config.objects.voting.vote_threshold) == (3, 4)
    assert config.objects.voting.distance_threshold == 0.05
    assert config.objects.clouds == Config().objects.clouds


def test_single_override_needs_no_list() -> None:
    assert load_config("paper", "seed=3") == load_config("paper", ["seed=3"])


def test_seed_can_be_larger_than_other_numbers() -> None:
    assert load_config(overrides=[f"seed={2**32}"]).seed == 2**32
    with pytest.raises(ConfigError, match=r"features\.count: input should be between 1 and 1e\+06, got 4294967296"):
        load_config(overrides=[f"features.count={2**32}"])


def test_dumped_configuration_loads_as_the_same(tmp_path: Path) -> None:
    config = load_config(None, ["objects.voting.time_spans=[0.0, 0.5]", "loop.enabled=false"])
    file = tmp_path / "config.yaml"
    file.write_text(dump_config(config))
    assert load_config(file) == config


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("objects.votng.vote_threshold=2", "did you mean objects.voting?"),
        ("objects.voting.votes=2", "did you mean objects.voting.vote_threshold?"),
        ("sed=2", "did you mean seed?"),
        ("SEED=2", "did you mean seed?"),
        ("depth.wxyz=2", "unknown key depth.wxyz; choose from kernel_size, sigma, edge_ratio"),
        ("features.count=true", "features.count: input should be a number, got True"),
        ("segmentation.source=no", "input should be 'yolo', 'masks' or 'none', got False"),
        (
            "segmentation.source=my:Cls",
            "not yolo, masks or none; for a segmenter by import path, set stages.segment=my:Cls",
        ),
        ("segmentation.source={a: 1}", "input should be 'yolo', 'masks' or 'none', got {'a': 1}"),
        ("depth.sigma=yes", "depth.sigma: input should be a number, got True"),
        ("depth.kernel_size=true", "depth.kernel_size: input should be a number, got True"),
        ("objects.voting.time_spans=[0, true]", "time_spans: input should be a number, got [0, True]"),
        ("objects.voting.time_spans=0.3", "objects.voting.time_spans: input should be a list such as [0.3], got 0.3"),
        ("seed", "write section.key=value"),
        ("seed=-1", "greater than or equal to 0"),
        ("seed=abc", "valid integer"),
        ("objects=3", "valid dictionary"),
        ("seed=[", "not valid YAML"),
        ("seed=010", "YAML reads a leading zero as octal; write 10 instead"),
        ("seed= 008", "YAML reads a leading zero as octal; write 8 instead"),
        ("segmentation.height=481", "multiple of 32"),
        ("objects.clouds.voxel_size=1e-9", "clouds.voxel_size: input should be greater than or equal to 0.001"),
        ("objects.free_space.min_tolerance=1e-9", "min_tolerance: input should be greater than or equal to 0.001"),
        ("dense_map.voxel_size=1e-9", "dense_map.voxel_size: input should be greater than or equal to 0.001"),
        ("dense_map.mesh.voxel_size=1e-9", "mesh.voxel_size: input should be greater than or equal to 0.005"),
        ("objects.tracker.acceleration_noise=.inf", "acceleration_noise: input should be a finite number, got inf"),
        ("objects.clouds.voxel_size=.inf", "clouds.voxel_size: input should be a finite number, got inf"),
        ("dense_map.voxel_size=.inf", "dense_map.voxel_size: input should be a finite number, got inf"),
        ("dense_map.mesh.voxel_size=.inf", "mesh.voxel_size: input should be a finite number, got inf"),
        ("dense_map.mesh.truncation=.inf", "mesh.truncation: input should be a finite number, got inf"),
        ("occupancy.voxel_size=.inf", "occupancy.voxel_size: input should be a finite number, got inf"),
        ("objects.free_space.time_spans=[-0.3]", "free_space.time_spans.0: input should be greater than or equal to 0"),
        ("objects.free_space.time_spans=[0.3,11]", "free_space.time_spans.1: input should be less than or equal to 10"),
        ("dense_odometry.halvings=[-1]", "dense_odometry.halvings.0: input should be greater than or equal to 0"),
        ("dense_odometry.halvings=[13]", "dense_odometry.halvings.0: input should be less than or equal to 12"),
    ],
)
def test_invalid_override_is_rejected_with_a_fix(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match="--set") as raised:
        load_config(None, [override])
    assert message in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
        ("- 1\n- 2\n", "contains a list"),
        ("seeed: 1\n", "did you mean seed?"),
        (
            "objects.voting.distance_threshold: 0.1\n",
            "unknown key objects.voting.distance_threshold; write nested sections, objects: {voting:"
            " {distance_threshold: ...}}",
        ),
        ("objects: {voting.enabled: true}\n", "objects.voting.enabled; write nested sections, voting: {enabled: ...}"),
    ],
)
def test_invalid_file_is_rejected_with_its_path(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"bad\.yaml") as raised:
        load_config(file)
    assert message in str(raised.value)


def test_missing_file_is_rejected_with_its_path(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: is neither the name of a configuration .* nor a YAML file"):
        load_config(tmp_path / "none.yaml")


def test_empty_file_gives_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "empty.yaml"
    file.write_text("# nothing\n")
    assert load_config(file) == Config()


def test_every_configuration_of_the_package_loads_by_name() -> None:
    assert {"full", "paper", "baseline", "no_voting"} <= set(CONFIGS)
    for name, file in CONFIGS.items():
        assert file.is_relative_to(Path(v3d_torch.__file__).parent)  # so that it is in the wheel
        assert find_config(name) == file
        load_config(file)
    assert load_config(find_config("full")) == Config()
    assert load_config(find_config("baseline")).segmentation.source == "none"


def test_find_config_accepts_paths_and_rejects_unknown_names_with_a_list(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("seed: 3\n")
    assert load_config(find_config(own)).seed == 3
    with pytest.raises(ConfigError, match=r"^'': is neither"):
        find_config("")
    with pytest.raises(ConfigError, match=r"papper: is neither.*paper") as raised:
        find_config("papper")
    assert "no_voting" in str(raised.value)


def test_error_names_the_source_of_the_value(tmp_path: Path) -> None:
    file = tmp_path / "good.yaml"
    file.write_text("seed: 3\n")
    for override in ("sed=2", "seed=-1"):
        with pytest.raises(ConfigError, match=r"^--set"):
            load_config(file, [override])
    file.write_text("seed: -1\n")
    with pytest.raises(ConfigError, match=r"good\.yaml: seed"):
        load_config(file, ["threads=2"])


def test_errors_name_the_option_that_sets_a_value() -> None:
    for override in ("seed=010", "seed", "seed.x=1", "seed=[", "seed=-1"):
        with pytest.raises(ConfigError, match=r"^--seed"):
            override_config(Config(), [override], source="--seed")
