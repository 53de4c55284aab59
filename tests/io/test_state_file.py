"""State files: round trip, damaged and foreign files, pickled code, full disks."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch
from helpers.unpickled_code import CreatesFile

from v3d_torch.errors import InputError, OutputError
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.io.state_file import VERSION, read_state, write_state

CAMERA = PinholeCamera(fx=130.0, fy=130.0, cx=79.5, cy=59.5, width=160, height=120)


def write_value(path: Path, value: object = 1) -> bytes:
    write_state(path, {"about": "a test"}, {"value": value})
    return path.read_bytes()


def test_state_is_read_back_with_shared_tensors(tmp_path: Path) -> None:
    shared = torch.arange(6).view(2, 3)
    write_state(tmp_path / "s", {"ä": [1.5, float("inf")]}, {"a": shared, "b": [shared[1], float("nan")], "c": {1, 2}})
    about, state = read_state(tmp_path / "s", [set])
    assert about["ä"] == [1.5, float("inf")] and state["c"] == {1, 2}
    state["a"][1, 0] = 7
    assert state["b"][0].tolist() == [7, 4, 5] and state["b"][1] != state["b"][1]


def test_damaged_state_file_is_rejected(tmp_path: Path) -> None:
    content = write_value(tmp_path / "s", torch.ones(50))
    for damaged in (
        *(b"", b"v3d_torch state 4\n", b"\xff" * 300, content[:100], content[: len(content) // 2], content[:-1]),
        *(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :] for at in range(3, len(content), 97)),
    ):
        (tmp_path / "s").write_bytes(damaged)
        with pytest.raises(InputError, match=r"/s: (is damaged or not a state of a run|has state format)"):
            read_state(tmp_path / "s", [])
    with pytest.raises(InputError, match=r"cannot be read \(No such file"):
        read_state(tmp_path / "none", [])


def test_damaged_objects_with_a_right_checksum_are_rejected(tmp_path: Path) -> None:
    body = write_value(tmp_path / "s").split(b"\n", 2)[1] + b"\n"
    for objects in (b"", b"\x80\x02J\x01", b"\x80\x02K\x01Q."):  # a number that is cut off; an id that is no tuple
        digest = hashlib.sha256(body + objects).hexdigest()
        (tmp_path / "s").write_bytes(f"v3d_torch state {VERSION} sha256 {digest}\n".encode() + body + objects)
        with pytest.raises(InputError, match="/s: is damaged or not a state of a run"):
            read_state(tmp_path / "s", [])


def test_reading_runs_no_code_and_creates_allowed_classes_only(tmp_path: Path) -> None:
    write_value(tmp_path / "s", CreatesFile(tmp_path / "created"))
    with pytest.raises(InputError, match="damaged or not a state"):
        read_state(tmp_path / "s", [set])
    assert not (tmp_path / "created").exists()
    write_value(tmp_path / "s", CAMERA)
    with pytest.raises(InputError, match="damaged or not a state"):
        read_state(tmp_path / "s", [set])
    assert read_state(tmp_path / "s", [PinholeCamera])[1]["value"] == CAMERA


def test_state_of_another_version_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = write_value(tmp_path / "s")
    (tmp_path / "s").write_bytes(content.replace(b"state %d " % VERSION, b"state 9 ", 1))
    with pytest.raises(InputError, match=rf"/s: has state format 9, .* reads format {VERSION}"):
        read_state(tmp_path / "s", [])
    with monkeypatch.context() as patch:
        patch.setattr("v3d_torch.io.state_file.version", lambda _: "9.9")
        write_value(tmp_path / "s")
    with pytest.raises(InputError, match=r"/s: was written by v3d-torch 9\.9, this is"):
        read_state(tmp_path / "s", [])


@pytest.mark.parametrize("free", [0, 50, 3000])
def test_full_disk_keeps_the_previous_state(free: int, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    previous = write_value(tmp_path / "s")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free, hard))
    try:
        with pytest.raises(OutputError, match="/s: cannot be written"):
            write_value(tmp_path / "s", torch.ones(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / "s").read_bytes() == previous and len(list(tmp_path.iterdir())) == 1
