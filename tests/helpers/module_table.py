"""Table of the public functions: dtypes, devices and transforms of torch that each of them supports.

A cell is measured by running the function. A function that does not support a column has a reason in `REASONS`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch._subclasses import FakeTensorMode
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode

from helpers.camera_inputs import cast
from helpers.module_cases import CASES, FUNCTION_CASES, Case, Inputs, tensors, without_padding
from v3d_torch.optim.pose_refinement import refine_pose

DEVICE = "gpu"
"""Name of a fake device. Fake tensors on CUDA fail without a GPU when they are indexed."""

backend_registration._setup_privateuseone_for_python_backend(DEVICE)

BATCH, COUNT = 2, 12
"""Size of the inputs: small, because compilers unroll loops."""

ITERATIONS = 1
"""Iterations of solvers, for the same reason."""

FEW_ITERATIONS = (
    patch("v3d_torch.features.pnp_ransac.refine_pose", partial(refine_pose, iterations=ITERATIONS)),
    patch("v3d_torch.features.sampson._ROUNDS", 1),
    patch("v3d_torch.features.sampson._ITERATIONS", ITERATIONS),
    patch("v3d_torch.features.p3p._ROOT_ITERATIONS", ITERATIONS),
)

CASES_BY_FUNCTION: dict[str, Case] = {}
"""Cases by name of the public function; the soft vote of `hough_vote` is a case of its own."""

for _name, _case in (CASES | FUNCTION_CASES).items():
    _public = getattr(_case.function, "func", _case.function).__name__
    CASES_BY_FUNCTION[_public + (", soft" if _name.startswith("soft") else "")] = _case


class UnsupportedError(Exception):
    """A result that differs from the expected one."""


# ---------------------------------------------------------------- columns


def check_dtype(case: Case, dtype: torch.dtype) -> None:
    """The result is that of float64 for the same inputs, up to the precision of the dtype."""
    inputs = case.inputs(BATCH, COUNT, dtype)
    expected = tensors(function_of(case)(**cast(inputs, torch.float64)))
    tolerance = {torch.float64: 1e-9, torch.float32: 1e-4, torch.float16: 2e-3, torch.bfloat16: 1.6e-2}[dtype]
    for found, wanted in zip(tensors(function_of(case)(**inputs)), expected, strict=True):
        if found.is_floating_point() and found.dtype not in (
            dtype,
            torch.promote_types(dtype, torch.float32),
            torch.float64,
        ):
            raise UnsupportedError(f"the result is {found.dtype}")
        if found.is_floating_point() or not case.sampled:
            if found.is_floating_point() and (found.isinf() != wanted.isinf()).any():
                raise UnsupportedError("a result overflows")
            wanted = wanted.to(found.dtype)
            assert_close(found, wanted, tolerance)


def check_meta(case: Case) -> None:
    """The result on the device `meta` has the shape and dtype of the result on the CPU."""
    inputs = case.inputs(BATCH, COUNT, torch.float32)
    found = function_of(case)(**{name: each.to("meta") for name, each in inputs.items()})
    assert_same_layout(found, function_of(case)(**inputs), "meta")


def check_device(case: Case) -> None:
    """All operators get tensors of one device, which is not the CPU; the result is there. Fake tensors need no GPU."""
    inputs = case.inputs(BATCH, COUNT, torch.float32)
    expected = function_of(case)(**inputs)
    with FakeTensors():
        assert_same_layout(function_of(case)(**on_fake_gpu(inputs)), expected, DEVICE)


def check_no_synchronisation(case: Case) -> None:
    """No operator reads the value of a tensor on that device, for which the host would wait."""
    inputs = case.inputs(BATCH, COUNT, torch.float32)
    with FakeTensors(), NoHostRead():
        function_of(case)(**on_fake_gpu(inputs))


def check_compile(case: Case) -> None:
    """`torch.compile` captures the whole function in one graph, with the same result and the same gradients."""
    torch.compiler.reset()
    if case.differentiable and not case.sampled:
        function, arguments = with_gradients(case)
        compiled = torch.compile(function, fullgraph=True, backend="eager")
        leaves = [each.clone().requires_grad_() for each in arguments]
        found, expected = compiled(*leaves), function(*leaves)
        assert_same_result(case, found, expected)
        for one, other in zip(
            *(torch.autograd.grad(flatten(each).sum(), leaves) for each in (found, expected)), strict=True
        ):
            assert_same_derivative(case, one, other)
        return
    inputs = case.inputs(BATCH, COUNT, torch.float64)
    compiled = torch.compile(function_of(case), fullgraph=True, backend="eager")
    assert_same_result(case, compiled(**inputs), function_of(case)(**inputs))


def check_export(case: Case) -> None:
    """`torch.export` captures the function, with the same result."""
    inputs = case.inputs(BATCH, COUNT, torch.float64)
    program = torch.export.export(AsModule(function_of(case)), (), inputs)
    assert_same_result(case, program.module()(**inputs), function_of(case)(**inputs))


def check_vmap(case: Case) -> None:
    """`torch.func.vmap` over the batch, of which each call gets one problem, gives the rows of the whole batch."""
    inputs = case.inputs(BATCH, COUNT, torch.float64)

    def apply(*row: Tensor) -> tuple[Tensor, ...]:
        return tensors(function_of(case)(**dict(zip(inputs, row, strict=True))))

    mapped = torch.func.vmap(apply)(*(each.unflatten(0, (BATCH, 1)) for each in inputs.values()))
    assert_same_result(case, tuple(each.flatten(0, 1) for each in mapped), function_of(case)(**inputs))


def check_grad(case: Case) -> None:
    """`torch.func.grad` gives the gradients of `torch.autograd`."""
    function, arguments = with_gradients(case)
    found = torch.func.grad(lambda *each: flatten(function(*each)).sum(), argnums=tuple(range(len(arguments))))(
        *arguments
    )
    for one, other in zip(found, gradients(function, arguments), strict=True):
        assert_same_derivative(case, one, other)


def check_jacrev(case: Case) -> None:
    """The Jacobian of `torch.func.jacrev`, summed over the results, gives the gradient of `torch.autograd`."""
    function, arguments = with_gradients(case)
    found = torch.func.jacrev(lambda *each: flatten(function(*each)))(*arguments)
    assert_same_derivative(case, found.sum(dim=0), gradients(function, arguments)[0])


COLUMNS: dict[str, Callable[[Case], None]] = {
    **{
        str(dtype).removeprefix("torch."): partial(check_dtype, dtype=dtype)
        for dtype in (torch.float64, torch.float32, torch.float16, torch.bfloat16)
    },
    "meta": check_meta,
    "other device": check_device,
    "no synchronisation": check_no_synchronisation,
    "compile": check_compile,
    "export": check_export,
    "vmap": check_vmap,
    "grad": check_grad,
    "jacrev": check_jacrev,
}


GRADIENTS = ("grad", "jacrev")
"""Columns of functions whose results have gradients."""

_BY_PIXEL_COUNT = "the pyramid levels use only the usable pixels, and their number depends on values"
_ON_HOST = "SciPy solves the assignment on the host: the shortest augmenting paths are found one after the other"
REASONS = {
    **{
        ("align_depth", column): _BY_PIXEL_COUNT
        for column in ("meta", "other device", "no synchronisation", "compile", "export", "vmap")
    },
    ("match_instances", "no synchronisation"): _ON_HOST,
}
"""Reason for each cell in which a function does not work."""


def error_in(case: Case, column: str) -> Exception | None:
    """Error of a function in a column; None if it supports the column."""
    try:
        with ExitStack() as stack:
            for each in FEW_ITERATIONS:
                stack.enter_context(each)
            COLUMNS[column](case)
    except Exception as error:  # a tracer can raise anything
        return error
    return None


def measure(name: str, column: str) -> str:
    """Cell of the table: yes, - for a result without gradients, or the reason why the function does not work.

    Raises:
        AssertionError: If the function does not work without a reason, or works despite one.
    """
    case, reason = CASES_BY_FUNCTION[name], REASONS.get((name, column))
    if column in GRADIENTS and not case.differentiable:
        return "-"
    error = error_in(case, column)
    if (error is None) != (reason is None):
        raise AssertionError(f"{name}, {column}: expected {reason or 'yes'}") from error
    return reason or "yes"


# ---------------------------------------------------------------- parts of the checks


class FakeTensors(FakeTensorMode):
    """Mode in which all tensors are fake, also those made from numbers, which torch else creates on the device."""

    avoid_device_init = True

    def __init__(self) -> None:
        super().__init__(allow_non_fake_inputs=True)


class NoHostRead(TorchDispatchMode):
    """Mode in which operators that bring values from a device to the host raise an error."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        given = [each for each in args if isinstance(each, Tensor)]
        is_copy = func.overloadpacket in (torch.ops.aten._to_copy, torch.ops.aten.copy_)
        if func.namespace == "v3d_torch" or (
            is_copy and result.device.type == "cpu" and given[-1].device.type != "cpu"
        ):
            raise UnsupportedError(f"{func} reads values on the host")
        return result


class AsModule(torch.nn.Module):
    """A function as a module, which `torch.export` needs."""

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__()
        self.function = function

    def forward(self, **inputs: Tensor) -> tuple[Tensor, ...]:
        return tensors(self.function(**inputs))


def function_of(case: Case) -> Callable[..., object]:
    """The function with few iterations."""
    settings = getattr(case.function, "keywords", {})
    return partial(case.function, iterations=ITERATIONS) if "iterations" in settings else case.function


def on_fake_gpu(inputs: Inputs) -> Inputs:
    return {name: torch.empty(each.shape, dtype=each.dtype, device=DEVICE) for name, each in inputs.items()}


def with_gradients(case: Case) -> tuple[Callable[..., tuple[Tensor, ...]], list[Tensor]]:
    """Function from the differentiable arguments to the results of one problem, 0 if not finite, and the arguments."""
    inputs = case.inputs(1, COUNT, torch.float64)

    def function(*arguments: Tensor) -> tuple[Tensor, ...]:
        results = tensors(function_of(case)(**(inputs | dict(zip(case.differentiable, arguments, strict=True)))))
        return tuple(torch.where(each.isfinite(), each, 0.0) for each in results if each.is_floating_point())

    return function, [inputs[name] for name in case.differentiable]


def flatten(results: tuple[Tensor, ...]) -> Tensor:
    return torch.cat([each.flatten() for each in results])


def gradients(function: Callable[..., tuple[Tensor, ...]], arguments: list[Tensor]) -> tuple[Tensor, ...]:
    leaves = [each.clone().requires_grad_() for each in arguments]
    return torch.autograd.grad(flatten(function(*leaves)).sum(), leaves)


def assert_same_layout(found: object, expected: object, device: str) -> None:
    """Assert that results lie on a device and have the dtypes and shapes of the expected ones."""
    for one, other in zip(tensors(found), tensors(expected), strict=True):
        if one.device.type != device:
            raise UnsupportedError(f"a result is on the device {one.device}")
        if one.dtype != other.dtype or without_padding(one, other).shape != other.shape:
            layout = one.dtype, tuple(one.shape)
            raise UnsupportedError(f"a result is {layout}, expected {other.dtype, tuple(other.shape)}")


def assert_same_result(case: Case, found: object, expected: object) -> None:
    """Assert that results agree, except for the random samples of compiled code."""
    for one, other in zip(tensors(found), tensors(expected), strict=True):
        one = without_padding(one, other)
        if case.sampled:
            assert one.shape == other.shape and one.dtype == other.dtype
        else:
            assert_close(one, other, 1e-5)


def assert_same_derivative(case: Case, found: Tensor, expected: Tensor) -> None:
    """Assert that derivatives agree; those at the optima of other random samples are only finite."""
    if case.sampled:
        assert found.shape == expected.shape and found.isfinite().all()
    else:
        assert_close(found, expected, 1e-6)


def assert_close(found: Tensor, expected: Tensor, tolerance: float) -> None:
    """Assert that results agree."""
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance, equal_nan=True)
