"""Stages by import path: what can be imported, and one sentence for each mistake."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.own_stages import MODULE, write_own_stages

from v3d_torch.config import Config, StagesConfig
from v3d_torch.config.loading import dump_config, load_config
from v3d_torch.errors import ConfigError, InputError, StageError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.runtime.stage_import import first_not_given, import_stage, make_stage

CAMERA = PinholeCamera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)


RAISING = """
from v3d_torch.errors import InputError


class AtStart:
    def __init__(self, config, camera):
        raise RuntimeError("no\\nlicence")


class WithoutMessage:
    def __init__(self, config, camera):
        assert camera is None


class OfTheInput:
    def __init__(self, config, camera):
        raise InputError("x.onnx: is missing; download it")


class Exit:
    def __init__(self, config, camera):
        raise SystemExit(2)


class WhenCalled:
    def __init__(self, config, camera):
        pass

    def __call__(self, number):
        if number < 0:
            raise InputError("no image")
        if number > 9:
            raise SystemExit(number)
        return 1 / number

    method = __call__
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    folder = write_own_stages(tmp_path)
    (folder / "broken_stages.py").write_text("import a_package_that_is_missing\n")
    (folder / "wrong_stages.py").write_text("raise ValueError('two\\nlines')\n")
    (folder / "leaving_stages.py").write_text("raise SystemExit\n")
    (folder / "raising_stages.py").write_text(RAISING)
    monkeypatch.syspath_prepend(folder)
    yield folder
    for name in (MODULE, "broken_stages", "wrong_stages", "leaving_stages", "raising_stages"):
        sys.modules.pop(name, None)


def test_class_gets_configuration_and_camera(own: Path) -> None:
    config = Config()
    segment = make_stage("segment", f"{MODULE}:Corner", config, CAMERA)
    assert segment.size == (48, 64) and segment.threshold == config.segmentation.score_threshold
    assert import_stage("smooth_depth", f"{MODULE}:Outer.Same").__qualname__ == "Outer.Same"


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (MODULE, "is not an import path; write module:attribute, such as my_package:MyStage"),
        (f"{MODULE}.Corner", "is not an import path"),
        (":Corner", "is not an import path"),
        (f"{MODULE}:", "is not an import path"),
        ("", "is not an import path"),
        ("no_such_stages:Stage", "the module no_such_stages cannot be imported (ModuleNotFoundError: No module named"),
        (".relative:Stage", "the module .relative cannot be imported (TypeError: "),
        ("broken_stages:Stage", "(ModuleNotFoundError: No module named 'a_package_that_is_missing'); correct it, ins"),
        ("wrong_stages:Stage", "the module wrong_stages cannot be imported (ValueError: two lines); correct it, inst"),
        ("leaving_stages:Stage", "the module leaving_stages cannot be imported (SystemExit); correct it, inst"),
        (f"{MODULE}:Missing", f"{MODULE} has no attribute Missing; correct the name after the colon"),
        (f"{MODULE}:Corner:Same", "has no attribute Corner:Same"),
        (f"{MODULE}:number", "is a int, which cannot be called; name a class, or a function that returns the stage"),
        (f"{MODULE}:one_argument", "does not accept two arguments, config and camera (too many positional arguments)"),
        ("raising_stages:AtStart", "cannot be made (RuntimeError: no licence); correct it"),
        ("raising_stages:WithoutMessage", "cannot be made (AssertionError); correct it"),
        ("raising_stages:Exit", "cannot be made (SystemExit: 2); correct it"),
        ("raising_stages:OfTheInput", "cannot be made (x.onnx: is missing; download it); correct it"),
        (f"{MODULE}:nothing", "returned a NoneType, which cannot be called; return the stage"),
    ],
)
def test_mistake_is_one_sentence_with_the_key(own: Path, path: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make_stage("odometry", path, Config(), CAMERA)
    assert str(caught.value).startswith(f"stages.odometry={path}: ")
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_error_of_a_stage_names_the_stage(own: Path) -> None:
    stage = make_stage("segment", "raising_stages:WhenCalled", Config(), CAMERA)
    for call in (stage, stage.method):
        with pytest.raises(StageError) as caught:
            call(0)
        assert str(caught.value) == (
            "stages.segment=raising_stages:WhenCalled failed with ZeroDivisionError: division by zero"
        )
        assert isinstance(caught.value.__cause__, ZeroDivisionError)
    with pytest.raises(StageError, match=r"^stages.segment=raising_stages:WhenCalled failed with SystemExit: 10$"):
        stage(10)
    assert stage(2) == stage.method(2) == 0.5
    with pytest.raises(InputError, match=r"^no image$"):
        stage(-1)


def test_reading_and_writing_a_configuration_imports_nothing(own: Path, tmp_path: Path) -> None:
    config = load_config(overrides=[f"stages.segment={MODULE}:Corner", "stages.odometry=no_such_stages:Odometry"])
    (tmp_path / "config.yaml").write_text(dump_config(config))
    assert load_config(tmp_path / "config.yaml") == config
    assert MODULE not in sys.modules


def test_only_stages_that_the_user_gives_as_well_are_accepted() -> None:
    stored = StagesConfig(segment="a:A", odometry="b:B")
    assert first_not_given(stored, stored) is None and first_not_given(StagesConfig(), stored) is None
    assert first_not_given(stored, StagesConfig(segment="a:A")) == "stages.odometry=b:B"
    assert first_not_given(stored, StagesConfig(segment="c:C", odometry="b:B")) == "stages.segment=a:A"
