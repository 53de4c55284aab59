"""Choice between kernels and torch functions, folder of the compiled code, progress of the compilation."""

from __future__ import annotations

import getpass
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import pytest
import torch
from rich.console import Console
from torch import Tensor

from v3d_torch.kernels import compiler
from v3d_torch.kernels.compiler import TWINS, Twin, can_read, compiled_by
from v3d_torch.runs import kernel_compilation

needs_numba = pytest.mark.skipif(not compiler.ENABLED, reason="numba is not installed, or V3D_KERNELS=torch is set")


def python(code: str, **variables: str) -> str:
    """Run code in a new process, in an environment without the folder of the tests' kernels."""
    kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "V3D_KERNELS")}
    done = subprocess.run([sys.executable, "-c", code], env=kept | variables, capture_output=True, text=True)  # noqa: S603
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def double() -> Iterator[list[str]]:
    """Names of the implementations of `doubled` that were called."""
    yield []
    TWINS.pop(f"{__name__}.make_doubled.<locals>.doubled", None)


def make_doubled(  # type: ignore[no-untyped-def]
    calls: list[str], supported: torch.dtype = torch.float64, *, on_demand: bool = True
):
    def compiled(x: Tensor) -> Tensor:
        if x.dtype != supported:
            return NotImplemented
        calls.append("kernel")
        return 2 * x

    @compiled_by(compiled, on_demand=on_demand)
    def doubled(x: Tensor) -> Tensor:
        """Twice a number."""
        calls.append("torch")
        return 2 * x

    return doubled


@needs_numba
def test_function_that_compiles_nothing_on_demand_waits_for_the_kernels_of_the_run(
    double: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    doubled = make_doubled(double, on_demand=False)
    x = torch.ones(1, dtype=torch.float64)
    for waiting in ([("kernel", "signature")], []):
        monkeypatch.setattr(compiler, "_TO_COMPILE", waiting)
        assert doubled(x) == 2
    assert double == ["torch", "kernel"]


@needs_numba
def test_kernel_runs_for_plain_tensors_only(double: list[str]) -> None:
    doubled = make_doubled(double)
    doubled(torch.ones(1, dtype=torch.float64))
    doubled(torch.ones(1))  # another dtype
    doubled(torch.ones(1, dtype=torch.float64, requires_grad=True))
    doubled(torch.ones(1, dtype=torch.float64, device="meta"))
    with torch.autograd.forward_ad.dual_level():
        doubled(torch.ones(1, dtype=torch.float64))
    torch.jit.trace(doubled, torch.ones(1, dtype=torch.float64), check_trace=False)
    assert double == ["kernel", "torch", "torch", "torch", "torch", "torch"]
    assert doubled.__doc__ == "Twice a number."


def test_both_implementations_are_registered() -> None:
    assert all(isinstance(twin, Twin) and twin.torch is not twin.compiled for twin in TWINS.values())
    assert "v3d_torch.optim.pose_refinement._minimise" in TWINS


def test_variable_turns_kernels_off() -> None:
    code = (
        "import sys, v3d_torch.optim.pose_refinement, v3d_torch.kernels.compiler as c\n"
        "print(c.ENABLED, 'numba' in sys.modules)"
    )
    assert python(code, V3D_KERNELS="torch") == "False False"


@needs_numba
@pytest.mark.parametrize(
    ("variables", "parent"),
    [
        ({"NUMBA_CACHE_DIR": "{}/numba"}, "{}/numba"),
        ({"V3D_CACHE": "{}/cache"}, "{}/cache/kernels"),
        # A file is in the place of the folder.
        ({"V3D_CACHE": "{}/file/cache", "TMPDIR": "{}/tmp"}, "{}/tmp"),
    ],
)
def test_code_is_kept_in_a_private_folder(
    tmp_path: Path, variables: dict[str, str], parent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "tmp").mkdir()
    monkeypatch.delenv("NUMBA_CACHE_DIR")  # of the tests
    monkeypatch.setattr(tempfile, "tempdir", None)  # which the module remembers
    for name, value in variables.items():
        monkeypatch.setenv(name, value.format(tmp_path))
    folder = compiler._code_folder.__wrapped__()  # without the folder found earlier
    assert folder.is_relative_to(parent.format(tmp_path)) and folder.is_dir()
    assert folder.stat().st_mode & 0o022 == 0


@needs_numba
@pytest.mark.parametrize("cache", ["{}/cache", "{}/file/cache"], ids=["cache folder", "temporary folder"])
def test_user_without_a_name_has_a_folder(tmp_path: Path, cache: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As with the user id of another machine in a container."""

    def no_name() -> str:
        raise KeyError("getpwuid(): uid not found: 1000")

    (tmp_path / "file").touch()
    monkeypatch.setattr(getpass, "getuser", no_name)
    monkeypatch.delenv("NUMBA_CACHE_DIR")  # of the tests
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("V3D_CACHE", cache.format(tmp_path))
    assert compiler._code_folder.__wrapped__().is_relative_to(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
def test_folder_that_others_can_write_is_not_used(tmp_path: Path) -> None:
    open_to_all = tmp_path / "kernels"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    assert not compiler._make_private(open_to_all)
    assert compiler._make_private(tmp_path / "other" / "kernels")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
def test_folder_that_others_can_replace_is_not_used(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    folder = shared / "mine" / "kernels" / "version"
    shared.chmod(0o777)
    assert compiler._make_private(folder) is None
    shared.chmod(0o1777)  # as a temporary folder, in which only the owner can rename a file
    assert compiler._make_private(folder) == folder


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can make files of other users")
def test_folder_below_that_of_another_user_is_not_used(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    folder = other / "kernels" / "version"
    assert compiler._make_private(folder) == folder
    os.chown(other, 65534, 65534)
    assert compiler._make_private(folder) is None


@pytest.mark.skipif(os.name == "nt", reason="symbolic links on Windows need special permissions")
def test_folder_behind_a_link_is_used_without_the_link(tmp_path: Path) -> None:
    """Another user can change a link after the check."""
    link = tmp_path / "link"
    link.symlink_to(tmp_path)
    assert compiler._make_private(link / "kernels" / "version") == tmp_path / "kernels" / "version"
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert compiler._make_private(loop / "kernels") is None


def test_compilation_is_announced_once_and_loading_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    class Helper:
        killed = False

        def __enter__(self) -> Helper:
            return self

        def __exit__(self, *_: object) -> None:
            assert self.killed

        def kill(self) -> None:
            self.killed = True

    monkeypatch.setattr(kernel_compilation, "_start_compiling_backwards", Helper)
    for steps, expected in (([(0, 2), (0, 1), (0, 0)], 0), ([(0, 2), (1, 1), (2, 0)], 1)):
        monkeypatch.setattr(compiler, "compile_kernels", lambda steps=steps: iter(steps))
        text = StringIO()
        kernel_compilation.compile_with_progress(Console(file=text))
        assert text.getvalue().count("compiling kernels for this processor") == expected


def test_second_process_imports_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "v3d_torch.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    with kernel_compilation._start_compiling_backwards() as helper:
        assert helper.wait() == 0
    assert not (tmp_path / "imported").exists()


@needs_numba
def test_code_is_shared_by_copies_of_a_file_and_not_by_other_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiler, "_code_folder", lambda: tmp_path)
    monkeypatch.setattr(compiler, "_TO_COMPILE", compiler.deque())
    source = "from v3d_torch.kernels.compiler import kernel\n@kernel('f8(f8)')\ndef scale(x):\n    return {} * x\n"
    compiled = []
    for folder, factor in (("one", 2), ("copy", 2), ("other", 3)):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "scaling.py"
        path.write_text(source.format(factor))
        scale = runpy.run_path(str(path), run_name="scaling")["scale"]
        compiled += [count for count, _ in compiler.compile_kernels()]
        assert scale(5.0) == factor * 5
    assert compiled == [1, 0, 1]


@needs_numba
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize("kept", [0, 0.5])
def test_kernel_with_a_damaged_file_in_the_cache_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, kept: float
) -> None:
    """As after a loss of power, which leaves files empty or truncated."""
    monkeypatch.setattr(compiler, "_code_folder", lambda: tmp_path)
    monkeypatch.setattr(compiler, "_TO_COMPILE", compiler.deque())
    path, compiled = tmp_path / "scaling.py", []
    path.write_text(
        "from v3d_torch.kernels.compiler import kernel\n@kernel('f8(f8)')\ndef scale(x):\n    return 2 * x\n"
    )
    for run in range(3):
        scale = runpy.run_path(str(path), run_name="scaling")["scale"]
        compiled += [count for count, _ in compiler.compile_kernels()]
        assert scale(5.0) == 10
        if run == 0:
            (damaged,) = tmp_path.glob(f"*{suffix}")
            os.truncate(damaged, int(kept * damaged.stat().st_size))
    assert compiled == [1, 1, 0]


def test_parameter_of_a_module_can_be_read() -> None:
    plain = torch.zeros(2, requires_grad=True)
    assert can_read(plain) and can_read(torch.nn.Parameter(plain.detach()))
    assert not can_read(torch.zeros(2, device="meta"))
