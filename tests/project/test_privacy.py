"""Privacy: commands and their imports make no connections, and write only files of the package."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from ctypes.util import find_library
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from helpers.commands import files_in
from helpers.no_network import KILLED, can_forbid_internet, forbid_internet
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from v3d_torch.config import SegmentationConfig
from v3d_torch.io.paths import cache_dir
from v3d_torch.segmentation import YOLOSegmenter
from v3d_torch.segmentation.onnx_runtime import import_onnxruntime

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]

Call = Callable[..., subprocess.CompletedProcess[str]]

SYSTEM = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH", "SYSTEMROOT") if name in os.environ}
"""Variables that programs need on some systems."""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    folder = tmp_path / "home"
    for name in (".cache", "tmp", "work"):
        (folder / name).mkdir(parents=True)
    return folder


@pytest.fixture
def call(home: Path) -> Call:
    """Function that runs Python in an empty home; an internet socket ends the process with the return code `KILLED`."""

    def run(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        own = {"HOME": home, "USERPROFILE": home, "XDG_CACHE_HOME": home / ".cache", "TMPDIR": home / "tmp"}
        # Without settings of the developer; kernels are not compiled again.
        kept = {"NUMBA_CACHE_DIR": os.environ["NUMBA_CACHE_DIR"], "PYTHONDONTWRITEBYTECODE": "1", "NO_COLOR": "1"}
        return subprocess.run(  # noqa: S603
            [sys.executable, *arguments],
            cwd=home / "work",
            env=SYSTEM | {name: str(path) for name, path in own.items()} | kept | variables,
            preexec_fn=forbid_internet if can_forbid_internet() else None,
            capture_output=True,
            text=True,
            timeout=500,
        )

    return run


@pytest.mark.skipif(not can_forbid_internet(), reason="no filter of system calls on this system")
@pytest.mark.parametrize("family", ["AF_INET", "AF_INET6"])
def test_internet_socket_ends_a_process(call: Call, family: str) -> None:
    code = f"import socket; socket.socketpair(); print(1, flush=True); socket.socket(socket.{family}); print(2)"
    done = call("-c", code)
    assert (done.returncode, done.stdout) == (KILLED, "1\n")


def test_imports_of_dependencies_and_package_write_no_file_and_open_no_connection(call: Call, home: Path) -> None:
    """A version of a dependency that begins to collect data fails here; the last name printed is its name."""
    code = """
import os, pkgutil, socket, sys, v3d_torch.cli
from importlib import import_module
from v3d_torch.segmentation.onnx_runtime import import_onnxruntime

def load(name):
    print(name, flush=True)
    import_onnxruntime() if name == "onnxruntime" else import_module(name)
    written = {os.path.join(folder, file) for folder, _, files in os.walk(os.environ["HOME"]) for file in files}
    if any(os.path.join(".cache", "v3d_torch") not in path for path in written):
        sys.exit(f"{name} writes {written}")

socket.has_ipv6 = False  # urllib3 would bind a local socket to find out
for module in pkgutil.walk_packages(v3d_torch.__path__, "v3d_torch."):
    load(module.name)
assert "onnxruntime" not in sys.modules, "imported without a network that runs"
for name in sys.argv[1:]:
    load(name)
print("end")
"""
    needed = [*PROJECT["dependencies"], *(PROJECT["optional-dependencies"][extra][0] for extra in ("ray", "rerun"))]
    names = {canonicalize_name(Requirement(line).name) for line in needed}
    modules = sorted(
        module
        for module, distributions in packages_distributions().items()
        if names & set(map(canonicalize_name, distributions)) and module.isidentifier() and not module.startswith("_")
    )
    if find_library("usb-1.0") is None:  # pyrealsense2 cannot be imported without it; no other module needs it
        modules.remove("pyrealsense2")
    assert {"torch", "onnxruntime", "cv2", "ray", "rerun", "matplotlib"} <= set(modules)
    done = call("-c", code, *modules)
    assert (done.returncode, done.stdout.split()[-1:]) == (0, ["end"]), done.stdout[-50:] + done.stderr
    assert not list_foreign_files(home)


def test_baseline_in_an_empty_home_writes_only_files_of_the_package(call: Call, home: Path, moment: Path) -> None:
    done = call("-m", "v3d_torch", "run", "--seq", str(moment), "--segmenter", "none", "--out", "out")
    assert done.returncode == 0, done.stderr
    assert not list_foreign_files(home)
    assert (home / "work" / "out" / "figures" / "trajectory.png").is_file()


def test_batch_with_the_network_in_an_empty_home_writes_only_files_of_the_package(
    call: Call, home: Path, moment: Path
) -> None:
    """The network runs in the process of the command, which checks it, and in the worker process of the run."""
    YOLOSegmenter(SegmentationConfig())  # downloads the weights and exports the network, if they are not in the cache
    cache = home / ".cache" / "v3d_torch"
    cache.mkdir()
    for name in ("weights", "networks"):
        (cache / name).symlink_to(cache_dir() / name)
    done = call("-m", "v3d_torch", "batch", "--seqs", str(moment), "--out", "out", "--workers", "2")
    assert done.returncode == 0, done.stderr + done.stdout
    assert not list_foreign_files(home)


def test_setting_of_the_user_for_the_telemetry_of_onnxruntime_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ORT_DISABLE_TELEMETRY", "0")
    import_onnxruntime()
    assert os.environ["ORT_DISABLE_TELEMETRY"] == "0"


def list_foreign_files(home: Path) -> set[str]:
    """Files outside of the cache of the package and of the working folder."""
    return {name for name in files_in(home) if not name.startswith((".cache/v3d_torch/", "work/"))}
