"""Sequences opened for a command, and notes on them."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.corpus.base import write_base
from rich.console import Console

from v3d_torch.config import Config
from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.demo.sequence import CAMERA
from v3d_torch.errors import InputError
from v3d_torch.runs.open_sequences import open_sequences, print_notes
from v3d_torch.runs.request import RunRequest


def requests(*sequences: object) -> list[RunRequest]:
    return [RunRequest(str(sequence), Config()) for sequence in sequences]


def test_damaged_ground_truth_is_rejected(tmp_path: Path) -> None:
    write_base(tmp_path / "seq")
    assert list(open_sequences(requests(tmp_path / "seq"), Console())) == ["seq"]
    (tmp_path / "seq" / "groundtruth.txt").write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"groundtruth\.txt: line 1 is '1 2 3'"):
        open_sequences(requests(tmp_path / "seq"), Console())


@pytest.mark.filterwarnings("ignore::v3d_torch.errors.GroundTruthWarning")
def test_damaged_ground_truth_is_noted_before_a_run(tmp_path: Path) -> None:
    write_base(tmp_path / "seq")
    output = StringIO()
    for _ in range(2):
        print_notes(load_sequence(tmp_path / "seq"), Console(file=output, width=300))
        (tmp_path / "seq" / "groundtruth.txt").write_text("1 2 3\n")
    (note,) = output.getvalue().splitlines()
    assert note.startswith(f"note: seq: the ground truth cannot be read: {tmp_path / 'seq' / 'groundtruth.txt'}: ")


@pytest.mark.parametrize(
    ("width", "height", "gigabytes"), [(640, 480, None), (1920, 1080, None), (3840, 2160, 4), (7680, 4320, 17)]
)
def test_memory_for_large_images_is_stated(width: int, height: int, gigabytes: int | None) -> None:
    source: Any = SimpleNamespace(name="hall", camera=replace(CAMERA, width=width, height=height))
    output = StringIO()
    print_notes(source, Console(file=output, width=300))
    expected = (
        f"note: hall: a run with images of {width}x{height} pixels needs about {gigabytes} GB of memory; scale images"
        " and camera file down if there is less\n"
    )
    assert output.getvalue() == ("" if gigabytes is None else expected)


def test_control_characters_of_names_do_not_reach_the_terminal() -> None:
    source: Any = SimpleNamespace(name="a\nb\x1b]0;title\x1b\\[red]", camera=replace(CAMERA, width=7680, height=4320))
    output = StringIO()
    print_notes(source, Console(file=output, width=300))
    assert output.getvalue().startswith("note: a\\nb\\x1b]0;title\\x1b\\[red]: a run with images of 7680x4320 pixels")
    assert output.getvalue().count("\n") == 1


def test_two_sequences_with_the_same_name_are_rejected(tmp_path: Path) -> None:
    first, second = (tmp_path / place / "seq" for place in ("home", "lab"))
    for folder in (first, second):
        write_base(folder)
    with pytest.raises(InputError, match=re.escape(f"{second}: {first} has the same name, seq; run them separately")):
        open_sequences(requests(first, second), Console())


def test_two_sequences_with_the_same_folder_of_results_are_rejected(tmp_path: Path) -> None:
    scenes, other = tmp_path / "chess" / "seq-01", tmp_path / "chess_seq-01"
    write_base(other)
    scenes.mkdir(parents=True)
    (scenes / "camera.yaml").write_text((other / "camera.yaml").read_text())
    for kind, name in (("rgb", "color"), ("depth", "depth")):
        for index, image in enumerate(sorted((other / kind).iterdir())):
            shutil.copyfile(image, scenes / f"frame-{index:06d}.{name}.png")
    assert [*open_sequences(requests(scenes), Console())] == ["chess/seq-01"]
    with pytest.raises(InputError, match=re.escape(f"{other}: {scenes} has the same name, chess_seq-01; run them")):
        open_sequences(requests(scenes, other), Console())


def test_all_sequences_that_are_not_valid_are_named(tmp_path: Path) -> None:
    names = [tmp_path / name for name in ("good", "empty", "missing", "damaged")]
    for folder in (names[0], names[3]):
        write_base(folder)
    names[1].mkdir()
    (names[3] / "groundtruth.txt").write_text("1 2 3\n")
    output = StringIO()
    with pytest.raises(InputError, match=f"^3 of 4 sequences are not valid, the first: {re.escape(str(names[1]))}: "):
        open_sequences(requests(*names, names[1]), Console(file=output, width=300))
    heading, *lines = output.getvalue().splitlines()
    assert heading == "These sequences are not valid:" and len(lines) == 3
    for name, line in zip(names[1:], lines, strict=True):
        assert line.startswith(str(name))
