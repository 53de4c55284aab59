"""Direction of gravity in a folder in TUM layout."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.long_wall import CAMERA, Slide

from v3d_torch.datasets import load_sequence
from v3d_torch.datasets.gravity_file import GRAVITY_FILE, read_gravity_file, write_gravity_file
from v3d_torch.datasets.tum_writer import TUMWriter
from v3d_torch.errors import InputError

DOWN = torch.tensor([0.1, 0.9, -0.3], dtype=torch.float64)
DOWN = DOWN / DOWN.norm()


def test_file_gives_the_written_direction(tmp_path: Path) -> None:
    write_gravity_file(tmp_path, 1305031102.175304, DOWN)
    gravity = read_gravity_file(tmp_path / GRAVITY_FILE, 1305031102.175304)
    assert gravity is not None and float(gravity.norm()) == pytest.approx(1, abs=1e-15)
    torch.testing.assert_close(gravity, DOWN, rtol=0, atol=1e-8)


def test_gravity_of_another_frame_is_not_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The first rows of the lists were removed."""
    with TUMWriter(tmp_path / "out", CAMERA) as writer:
        for frame in Slide(0, 12, step=6):
            writer.add(frame)
    write_gravity_file(tmp_path / "out", -1.0, DOWN)
    sequence = load_sequence(tmp_path / "out")
    assert sequence[0].gravity is None
    assert "gravity.txt: is of the frame at -1.000000 s, not of the first one; gravity is not used" in caplog.text


@pytest.mark.parametrize(
    "content",
    [
        "",
        "0.0\n",
        "0 0 0 0\n",
        "0 1 2 3\n",
        "0 nan 0 1\n",
        "nan 0 0 1\n",
        "0 0 down 0\n",
        "0 0 1 0 0\n",
        2 * "0 0 1 0\n",
    ],
)
def test_damaged_file_is_an_input_error(content: str, tmp_path: Path) -> None:
    with TUMWriter(tmp_path / "out", CAMERA) as writer:
        writer.add(Slide(0, 6, step=6)[0])
    path = tmp_path / "out" / GRAVITY_FILE
    path.write_text(content)
    with pytest.raises(InputError) as raised:
        load_sequence(tmp_path / "out")
    assert str(raised.value) == (
        f"{path}: is not a direction of gravity; copy it again, it has one line stamp gx gy gz, with a unit vector, or"
        " remove it"
    )
