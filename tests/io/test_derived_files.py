"""Files that are derived from others: written once, and again if they are damaged."""

from __future__ import annotations

from pathlib import Path

import pytest

from v3d_torch.errors import OutputError
from v3d_torch.io.derived_files import derive


class Writer:
    """Writer of two files that counts its calls."""

    calls = 0

    def __call__(self, *drafts: Path) -> None:
        self.calls += 1
        for number, draft in enumerate(drafts):
            draft.write_bytes(bytes([number]) * 100)


def damage_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[50] ^= 1
    path.write_bytes(content)


@pytest.fixture
def targets(tmp_path: Path) -> list[Path]:
    return [tmp_path / "one.onnx", tmp_path / "two.onnx"]


def test_files_that_exist_are_not_written_again(targets: list[Path]) -> None:
    write = Writer()
    for _ in range(2):
        derive(targets, write)
    assert write.calls == 1
    assert [target.read_bytes() for target in targets] == [b"\0" * 100, b"\1" * 100]


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:50]),
        damage_byte,
        lambda path: path.unlink(),
        lambda path: path.with_name(f".{path.name}.sha256").unlink(),  # as in the cache of an earlier version
        lambda path: path.with_name(f".{path.name}.sha256").write_bytes(b"\xff"),
    ],
    ids=["empty", "truncated", "one bit", "missing", "no digest", "damaged digest"],
)
def test_damaged_file_is_written_again(targets: list[Path], damage) -> None:  # type: ignore[no-untyped-def]
    write = Writer()
    derive(targets, write)
    expected = [target.read_bytes() for target in targets]
    damage(targets[1])
    for _ in range(2):
        derive(targets, write)
    assert write.calls == 2
    assert [target.read_bytes() for target in targets] == expected


def test_failed_writing_leaves_no_file(targets: list[Path]) -> None:
    def write(*drafts: Path) -> None:
        drafts[0].write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left on device"):
        derive(targets, write)
    assert not [path for path in targets[0].parent.iterdir() if path.suffix != ".lock"]
