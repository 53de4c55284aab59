"""Compilation of kernels with numba, and the choice between a kernel and its torch twin."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import stat
import tempfile
from collections import deque
from collections.abc import Callable, Iterator
from functools import cache, wraps
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.io.paths import cache_dir

_P = ParamSpec("_P")
_R = TypeVar("_R")
_F = TypeVar("_F", bound=Callable[..., Any])

ENABLED = os.environ.get("V3D_KERNELS") != "torch" and importlib.util.find_spec("numba") is not None
"""True if kernels run; false if numba is not installed or ``V3D_KERNELS=torch`` is set, so that torch twins run."""


class Twin(NamedTuple):
    """Two implementations of a function, with the same arguments and results."""

    torch: Callable[..., Any]
    compiled: Callable[..., Any]


TWINS: dict[str, Twin] = {}
"""All functions with two implementations, by qualified name."""

_TO_COMPILE: deque[tuple[Any, str]] = deque()
"""Kernels that are not yet loaded or compiled, each with its signature."""

_LOCK = Lock()


def kernel(signature: str) -> Callable[[_F], _F]:
    """Compile a function of arrays and numbers.

    The compiled code is stored in the user's cache, and releases the GIL while it runs. Floating-point operations are
    not reordered, so that the results are the same on each call; division by 0 gives infinity, as in NumPy.

    Args:
        signature: Types of the arguments in numba's notation, for example ``(f8[:,::1], i8)``.
    """

    def decorate(function: _F) -> _F:
        if not ENABLED:
            return function
        import numba

        njit: Any = numba.njit  # its type lacks some options
        settings = vars(numba.config)
        before = settings["CACHE_LOCATOR_CLASSES"]
        settings["CACHE_LOCATOR_CLASSES"] = f"{__name__}.{CodeLocator.__name__}"
        try:
            compiled = njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
        finally:
            settings["CACHE_LOCATOR_CLASSES"] = before
        _TO_COMPILE.append((compiled, signature))
        return cast("_F", compiled)

    return decorate


class CodeLocator:
    """Place of the compiled code of a function, for numba: the same for all copies of a source file.

    numba's own locators depend on the path of the source file, so that each checkout and each environment would compile
    the same kernels again. The methods are those of numba's cache locators.
    """

    def __init__(self, function: Callable[..., Any], source: str) -> None:
        self._line = function.__code__.co_firstlineno
        self._source = Path(source)

    @classmethod
    def from_function(cls, function: Callable[..., Any], source: str) -> CodeLocator:
        """Return the place of the code of a function."""
        return cls(function, source)

    def get_cache_path(self) -> str:
        """Return the folder of the code."""
        return str(_code_folder())

    def ensure_cache_path(self) -> None:
        """Create the folder, if something has deleted it."""
        _code_folder().mkdir(parents=True, exist_ok=True)

    def get_source_stamp(self) -> str:
        """Return the hash of the source file; code of another version of the file is not used."""
        return hashlib.sha256(self._source.read_bytes()).hexdigest()

    def get_disambiguator(self) -> str:
        """Return the line of the function, which distinguishes functions of the same name."""
        return str(self._line)


def device(function: _F) -> _F:
    """Compile a small function that kernels call, such as the projection of one point."""
    if not ENABLED:
        return function
    import numba

    njit: Any = numba.njit  # its type lacks some options
    options = {"nogil": True, "error_model": "numpy", "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast("_F", njit(**options)(function))


def compile_kernels(*, backwards: bool = False) -> Iterator[tuple[int, int]]:
    """Load all kernels of the imported modules from the cache, or compile those that are not in it.

    Args:
        backwards: True to start with the last kernel. Two processes, one of them backwards, take half the time.

    Yields:
        After each kernel, the number of kernels compiled so far, and the number of kernels still to be loaded.
    """
    compiled = 0
    while True:
        with _LOCK:
            if not _TO_COMPILE:
                return
            each, signature = _TO_COMPILE[-1 if backwards else 0]
            _load_or_compile(each, signature)
            each.disable_compile()  # arguments of other types are converted or raise an error
            _TO_COMPILE.remove((each, signature))
        compiled += sum(each.stats.cache_misses.values())
        yield compiled, len(_TO_COMPILE)


def _load_or_compile(function: Any, signature: str) -> None:
    """Load a kernel from the cache, or compile it if it is not in the cache, or if its files there are damaged."""
    try:
        function.compile(signature)
    except Exception:  # unpickling a damaged file can raise any error; another error is raised again below
        function._cache.flush()  # empties the index of this kernel, so that none of its files is loaded
        function.compile(signature)


def compiled_by(
    compiled: Callable[_P, _R], *, on_demand: bool = True
) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
    """Decorate a torch function with its compiled twin.

    The twin runs if all tensors among the arguments are on the CPU and need no gradient. It returns NotImplemented for
    arguments that it does not support, such as another dtype; the torch function then runs.

    Args:
        compiled: Function with the same arguments and results that calls a kernel.
        on_demand: False to call the kernel only if all kernels have been compiled before, as at the start of a run:
            they take a minute to compile, for which it is not worth waiting.
    """

    def decorate(function: Callable[_P, _R]) -> Callable[_P, _R]:
        name = f"{function.__module__}.{function.__qualname__}"
        TWINS[name] = Twin(function, compiled)

        @wraps(function)
        def either(*args: _P.args, **kwargs: _P.kwargs) -> _R:
            if ENABLED and not _is_traced() and all(map(_is_plain, args)) and all(map(_is_plain, kwargs.values())):
                if _TO_COMPILE and on_demand:
                    deque(compile_kernels(), maxlen=0)
                if on_demand or not _TO_COMPILE:
                    result = TWINS[name].compiled(*args, **kwargs)
                    if result is not NotImplemented:
                        return result
            return function(*args, **kwargs)

        return either

    return decorate


def to_array(tensor: Tensor) -> NDArray[Any]:
    """Return a tensor as an array in row-major order; the memory is shared if the tensor already has that order."""
    return np.ascontiguousarray(tensor.detach().numpy())


def can_read(tensor: Tensor) -> bool:
    """Check whether the values of a tensor can be read at once.

    Values on another device require waiting for the device. Meta tensors, and tensors that `torch.func` transforms or a
    compiler traces, have no values; those in forward-mode differentiation count as such.
    """
    is_plain = type(tensor) in (Tensor, torch.nn.Parameter)
    return not _is_traced() and is_plain and tensor.is_cpu


def is_all_true(mask: Tensor) -> bool:
    """Check whether a mask is true everywhere; False if its values cannot be read at once."""
    return can_read(mask) and bool(mask.all())


def is_transformed() -> bool:
    """Check whether `torch.func` or forward-mode differentiation transforms the computation; False in a compiler.

    A tensor with a tangent of forward-mode differentiation needs no gradient (``requires_grad`` is false), but compiled
    code would lose its tangent.
    """
    if torch.compiler.is_compiling():
        return False
    return torch._C._are_functorch_transforms_active() or torch.autograd.forward_ad._current_level >= 0


def _is_traced() -> bool:
    """Check whether a compiler or `torch.jit.trace` traces the computation, or a transform does."""
    is_recorded = torch.jit.is_tracing()  # type: ignore[attr-defined]  # its type stub lacks it
    return torch.compiler.is_compiling() or is_recorded or is_transformed()


def _is_plain(argument: object) -> bool:
    """Check whether an argument is not a tensor, or a tensor on the CPU without gradients."""
    if not isinstance(argument, Tensor):
        return True
    return type(argument) is Tensor and argument.is_cpu and not argument.requires_grad


@cache
def _code_folder() -> Path:
    """Folder of the compiled code of this version of the kernels; only this user can write it.

    numba recompiles a kernel when its file changes, but not when a called function in another file changes. The name of
    the folder therefore depends on all files.
    """
    files = sorted(Path(__file__).parent.glob("*.py"))
    version = hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    folder = _make_private((Path(chosen) if chosen else cache_dir() / "kernels") / version)
    if folder is None:
        # Without a cache folder, as in a container with a read-only home, use the system's temporary folder. A
        # container's user may have no name, and Windows has a temporary folder for each user.
        owner = f"v3d_torch-{os.getuid()}" if hasattr(os, "getuid") else "v3d_torch"
        folder = _make_private(Path(tempfile.gettempdir()) / owner / version)
    return folder or Path(tempfile.mkdtemp(prefix="v3d_torch-"))


def _make_private(folder: Path) -> Path | None:
    """Make a folder, and the one above it, that only this user can write; return its path without symbolic links.

    Compiled code in the folder runs with the rights of this user, so nobody else may write it, or replace a folder
    above it by another one.

    Returns:
        The path; None if the folder cannot be made, or if another user can write or replace it.
    """
    folder = Path(os.path.realpath(folder))  # another user can change where a link leads
    try:
        folder.parent.parent.mkdir(parents=True, exist_ok=True)
        for each in (folder.parent, folder):
            each.mkdir(mode=0o700, exist_ok=True)
        if hasattr(os, "getuid"):
            status = folder.lstat()
            is_own = status.st_uid == os.getuid() and not status.st_mode & 0o022
            if not is_own or any(map(_is_replaceable, folder.parents)):
                return None
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def _is_replaceable(folder: Path) -> bool:
    """Check whether another user than root can rename the folders in a folder."""
    status = folder.lstat()
    # The owner of the root folder is root, also where a container shows root under another id.
    if status.st_uid not in (0, os.getuid(), Path(folder.anchor).lstat().st_uid):
        return True
    # Many systems give each user a group with the same id, which has no other members, and let it write by default.
    has_own_group = status.st_gid == os.getgid() == os.getuid()
    is_writable = status.st_mode & (0o002 if has_own_group else 0o022)
    return bool(is_writable) and not status.st_mode & stat.S_ISVTX
