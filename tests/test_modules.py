"""Contract of all modules: batches, padding, dtypes, gradients, agreement with the functional form.

The test file of each module compares its numbers with other libraries.
"""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable, Iterable
from itertools import product

import pytest
import torch
from helpers import camera_inputs
from helpers.gradients import count_graph_nodes
from helpers.library_settings import default_dtype, torch_threads
from helpers.module_cases import (
    CAMERA,
    CAMERA_CASES,
    CASES,
    FUNCTION_CASES,
    Case,
    Inputs,
    Make,
    centroids,
    image,
    random,
    random_mask,
    tensors,
    without_padding,
)
from kornia.core.exceptions import ShapeError
from torch import Tensor
from torch.autograd import forward_ad

import v3d_torch as v3d
from v3d_torch.objects.instance_clouds import InstanceClouds

DTYPES = [torch.float32, torch.float64]
each = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
each_padded = pytest.mark.parametrize(
    "case", [i for i in CASES.values() if i.masks], ids=[n for n, i in CASES.items() if i.masks]
)
each_differentiable = pytest.mark.parametrize(
    "case", [i for i in CASES.values() if i.differentiable], ids=[n for n, i in CASES.items() if i.differentiable]
)


def assert_same(result: object, expected: object) -> None:
    """Assert that tensors are equal to the bit; NaN equals NaN."""
    for one, other in zip(tensors(result), tensors(expected), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


def fill(inputs: Inputs, masks: dict[str, str], filler: float) -> Inputs:
    """Inputs with another value in the padding."""
    filled = copy.deepcopy(inputs)
    for name, mask in masks.items():
        largest = 255 if inputs[name].dtype == torch.uint8 else 2**40
        filled[name][~inputs[mask]] = filler if inputs[name].is_floating_point() else largest
    return filled


def mask_names(case: Case) -> list[str]:
    return [name for name, each in case.inputs(1, 1, torch.float64).items() if each.dtype == torch.bool]


# ---------------------------------------------------------------- all modules


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("batch", "count"), list(product((0, 1, 3, 100), (0, 1, 100))))
@each
def test_module_accepts_any_size_and_dtype(case: Case, batch: int, count: int, dtype: torch.dtype) -> None:
    inputs = case.inputs(batch, count, dtype)
    before = copy.deepcopy(inputs)
    result = case.module(**inputs)
    for tensor in tensors(result):
        assert tensor.shape[0] == batch
        assert tensor.dtype in (dtype, torch.int64, torch.bool)
    assert any(tensor.dtype == dtype for tensor in tensors(result)) or not case.differentiable
    assert_same(case.function(**inputs), result)
    assert_same(tuple(inputs.values()), tuple(before.values()))  # inputs are not modified


@pytest.mark.parametrize("filler", [torch.nan, torch.inf, -torch.inf, 1e30, 0.0])
@each_padded
def test_content_of_padding_is_ignored(case: Case, filler: float) -> None:
    inputs = case.inputs(4, 30, torch.float64)
    assert_same(case.module(**fill(inputs, case.masks, filler)), case.module(**inputs))


@each_padded
def test_length_of_padding_is_ignored(case: Case) -> None:
    inputs = case.inputs(4, 30, torch.float64)
    longer = dict(inputs)
    for name, mask in case.masks.items():
        padding = torch.full_like(inputs[name][:, :7], torch.nan if inputs[name].is_floating_point() else 5)
        longer[name] = torch.cat([inputs[name], padding], dim=1)
        longer[mask] = torch.cat([inputs[mask], torch.zeros(4, 7, dtype=torch.bool)], dim=1)
    for one, other in zip(tensors(case.module(**longer)), tensors(case.module(**inputs)), strict=True):
        torch.testing.assert_close(one[tuple(map(slice, other.shape))], other, equal_nan=True)


@pytest.mark.parametrize("missing", [torch.nan, torch.inf, -1.0, 1e30])
def test_invalid_depth_counts_as_missing(missing: float) -> None:
    depth = image(2, 0, torch.float64)["depth"]
    smooth = v3d.DepthSmoother()
    expected = smooth(depth)
    assert_same(smooth(torch.where(depth > 0, depth, missing)), expected)
    wider = torch.nn.functional.pad(depth, (3, 2, 1, 4), value=missing)
    assert_same(smooth(wider)[..., 1:-4, 3:-2], expected)


@each
def test_rows_of_a_batch_are_independent(case: Case) -> None:
    inputs = case.inputs(3, 30, torch.float64)
    result = tensors(case.module(**inputs))
    for b in range(3):
        alone = tensors(case.module(**{name: tensor[b : b + 1] for name, tensor in inputs.items()}))
        for one, other in zip(alone, result, strict=True):
            row = other[b : b + 1]
            torch.testing.assert_close(one, row[tuple(map(slice, one.shape))], equal_nan=True)


@each
def test_module_is_deterministic_for_any_number_of_threads(case: Case) -> None:
    inputs = case.inputs(6, 200, torch.float32)
    result = case.module(**inputs)
    with torch_threads(2):
        assert_same(case.module(**inputs), result)


@each
def test_module_can_be_copied_and_pickled(case: Case) -> None:
    assert isinstance(case.module, torch.nn.Module)
    inputs = case.inputs(2, 20, torch.float32)
    expected = case.module(**inputs)
    twin = pickle.loads(pickle.dumps(case.module))  # noqa: S301
    assert_same(twin(**inputs), expected)
    twin = copy.deepcopy(case.module).eval()
    twin.load_state_dict(case.module.state_dict())
    assert_same(twin(**inputs), expected)
    assert not list(case.module.parameters())  # settings are numbers unless a parameter is given


@pytest.mark.parametrize("case", (CASES | FUNCTION_CASES).values(), ids=CASES | FUNCTION_CASES)
def test_default_dtype_does_not_change_the_result(case: Case) -> None:
    inputs = case.inputs(2, 12, torch.float32)
    expected = tensors(case.function(**inputs))
    with default_dtype(torch.float64):
        found = tensors(case.function(**inputs))
    assert [tensor.dtype for tensor in found] == [tensor.dtype for tensor in expected]
    assert_same(found, expected)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("case", (CASES | FUNCTION_CASES).values(), ids=CASES | FUNCTION_CASES)
def test_results_inside_autocast_equal_those_outside(case: Case, dtype: torch.dtype) -> None:
    inputs = case.inputs(2, 12, torch.float32)
    expected = case.function(**inputs)
    with torch.autocast("cpu", dtype):
        assert_same(case.function(**inputs), expected)


each_of_the_camera = pytest.mark.parametrize("case", CAMERA_CASES.values(), ids=CAMERA_CASES)


def by_position(case: Case, names: Iterable[str]) -> Callable[..., tuple[Tensor, ...]]:
    """The module as a function whose arguments have no names, as `torch.func.vmap` needs it."""
    return lambda *row: tensors(case.module(**dict(zip(names, row, strict=True))))


@each_of_the_camera
def test_module_can_be_mapped_over_a_batch(case: Case) -> None:
    """`torch.func.vmap` traces the torch functions; without it, compiled code may run."""
    inputs = case.inputs(2, 20, torch.float64)

    mapped = torch.func.vmap(by_position(case, inputs))(*inputs.values())
    for one, other in zip(mapped, tensors(case.module(**inputs)), strict=True):
        if case.sampled:
            assert one.shape == other.shape and one.dtype == other.dtype
        else:
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize(
    "case", [i for n, i in CASES.items() if n not in CAMERA_CASES], ids=[n for n in CASES if n not in CAMERA_CASES]
)
def test_clouds_can_be_mapped_over_a_batch(case: Case) -> None:
    """Torch functions, which compare all pairs of points, agree with compiled code and trees, except for padding."""
    inputs = case.inputs(3, 150, torch.float64)

    mapped = torch.func.vmap(by_position(case, inputs))(*(each.unflatten(0, (3, 1)) for each in inputs.values()))
    for one, other in zip(mapped, tensors(case.module(**inputs)), strict=True):
        torch.testing.assert_close(without_padding(one.flatten(0, 1), other), other, equal_nan=True)


GEOMETRIC = {
    **{name: case for name, case in CAMERA_CASES.items() if name != "DescriptorMatcher"},
    **{name: FUNCTION_CASES[name] for name in ("umeyama", "ate")},
}


@pytest.mark.parametrize("case", (CASES | FUNCTION_CASES).values(), ids=CASES | FUNCTION_CASES)
def test_integers_give_the_results_of_equal_floating_point_numbers(case: Case) -> None:
    inputs = {
        name: each.round() if each.is_floating_point() else each
        for name, each in case.inputs(1, 30, torch.float32).items()
    }
    as_integers = {name: each.to(torch.int64) if each.is_floating_point() else each for name, each in inputs.items()}
    assert_same(case.function(**as_integers), case.function(**inputs))


def assert_any_input_can_have_the_batch_dimension(case: Case, inputs: Inputs, name: str) -> None:
    """Compare a problem without batch dimension with two in which only one input has a batch dimension."""
    found = case.function(**inputs | {name: torch.stack([inputs[name]] * 2)})
    for one, other in zip(tensors(found), tensors(case.function(**inputs)), strict=True):
        assert one.shape == (2, *other.shape)
        torch.testing.assert_close(one, other.expand_as(one), equal_nan=True)


@pytest.mark.parametrize(
    ("case", "name"),
    [(case, name) for case in GEOMETRIC.values() for name in case.inputs(1, 1, torch.float64)],
    ids=[f"{title} {name}" for title, case in GEOMETRIC.items() for name in case.inputs(1, 1, torch.float64)],
)
def test_any_input_can_have_the_batch_dimension(case: Case, name: str) -> None:
    inputs = {key: each[0] for key, each in case.inputs(1, 30, torch.float64).items()}
    assert_any_input_can_have_the_batch_dimension(case, inputs, name)


@pytest.mark.parametrize("title", ["BundleAdjuster", "ReadoutEstimator", "PoseGraphOptimiser", "PnPRANSAC"])
def test_optional_input_can_have_the_batch_dimension(title: str) -> None:
    case = CASES[title]
    inputs = {key: each[0] for key, each in case.inputs(1, 30, torch.float64).items()}
    if title == "PnPRANSAC":
        name, value = "initial_guess", torch.eye(4, dtype=torch.float64)
    else:
        name, value = "fixed", torch.arange(5 if title == "PoseGraphOptimiser" else 3) == 0
    assert_any_input_can_have_the_batch_dimension(case, inputs | {name: value}, name)


MASKS = [
    *((title, name) for title, case in (CASES | FUNCTION_CASES).items() for name in mask_names(case)),
    *((title, "fixed") for title in ("BundleAdjuster", "ReadoutEstimator", "PoseGraphOptimiser")),
    *(("align_depth", name) for name in ("static_a", "static_b")),
]


@pytest.mark.parametrize("dtype", [torch.int64, torch.uint8, torch.float32])
@pytest.mark.parametrize(("title", "name"), MASKS)
def test_mask_of_another_type_than_bool_is_rejected(title: str, name: str, dtype: torch.dtype) -> None:
    case = (CASES | FUNCTION_CASES)[title]
    inputs = case.inputs(2, 12, torch.float32)
    mask = inputs.get(name, torch.ones(1, dtype=torch.bool)).to(dtype)
    with pytest.raises(v3d.InputError, match=rf"^{name} has the type {dtype}; give a mask of type torch\.bool$"):
        case.function(**inputs | {name: mask})


@pytest.mark.parametrize(("title", "name"), MASKS)
def test_mask_of_another_length_is_rejected(title: str, name: str) -> None:
    """A mask of length 1 would be applied to all rows."""
    case = (CASES | FUNCTION_CASES)[title]
    inputs = case.inputs(2, 12, torch.float32)
    with pytest.raises(ShapeError):
        case.function(**inputs | {name: torch.ones(2, 1, dtype=torch.bool)})


NUMBERS = [
    ("DepthSmoother", "sigma"),
    *product(("PoseRefiner", "BundleAdjuster", "ReadoutEstimator"), ("pixel_sigma", "inverse_depth_sigma")),
    ("PoseRefiner", "rounds"),
    *product(("EssentialRANSAC", "PnPRANSAC"), ("threshold", "iterations")),
]


@pytest.mark.parametrize("number", [0, -1, math.nan])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("title", "name"), NUMBERS)
def test_number_that_is_not_positive_is_rejected(title: str, name: str, dtype: torch.dtype, number: float) -> None:
    inputs = CASES[title].inputs(2, 12, dtype)
    with pytest.raises(v3d.ConfigError, match=f"^{name} is {number}; give a number above 0$"):
        CASES[title].function(**inputs | {name: number})


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize(
    ("title", "name"),
    [
        *product(("BundleAdjuster", "ReadoutEstimator"), ("T_cw", "points")),
        *product(("PoseGraphOptimiser",), ("T_wc", "T_ij")),
    ],
)
def test_poses_and_landmarks_that_are_not_finite_are_rejected(title: str, name: str, value: float) -> None:
    inputs = CASES[title].inputs(1, 30, torch.float64)
    inputs[name][0, 1] = value
    with pytest.raises(v3d.InputError, match=f"^{name} has a value that is not finite"):
        CASES[title].function(**inputs)


def change_value(values: Tensor, index: tuple[int, ...], value: float) -> Tensor:
    """Copy of a tensor with another value at an index of all problems of a batch."""
    changed = values.clone()
    changed[:, *index] = value
    return changed


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
@pytest.mark.parametrize("name", ["pixel_sigma", "inverse_depth_sigma"])
@pytest.mark.parametrize("title", ["PoseRefiner", "BundleAdjuster", "ReadoutEstimator"])
def test_standard_deviation_that_is_not_positive_is_rejected(title: str, name: str, value: float) -> None:
    """Poses became NaN, or the prediction was returned."""
    inputs = CASES[title].inputs(1, 30, torch.float64)
    first = int(inputs["valid"][0].nonzero()[0])
    sigma = torch.full_like(inputs["inverse_depth"], 0.5)
    with pytest.raises(v3d.InputError, match=f"^{name} has a value that is not positive"):
        CASES[title].function(**inputs | {name: change_value(sigma, (first,), value)})
    inputs["valid"][:, first] = False
    CASES[title].function(**inputs | {name: change_value(sigma, (first,), value)})  # padding


@pytest.mark.parametrize(
    ("row", "column", "value", "message"),
    [
        (0, 0, math.nan, "a value that is not finite"),
        (1, 2, math.inf, "a value that is not finite"),
        (0, 0, 0.0, "a focal length that is not positive"),
        (1, 1, -500.0, "a focal length that is not positive"),
        (2, 0, 320.0, "a last row other than"),
        (2, 2, 2.0, "a last row other than"),
    ],
)
@pytest.mark.parametrize("title", ["PoseRefiner", "PnPRANSAC", "BundleAdjuster", "ReadoutEstimator"])
def test_matrix_of_no_pinhole_camera_is_rejected(title: str, row: int, column: int, value: float, message: str) -> None:
    inputs = CASES[title].inputs(1, 30, torch.float64)
    with pytest.raises(v3d.InputError, match=f"^K has {message}"):
        CASES[title].function(**inputs | {"K": change_value(inputs["K"], (row, column), value)})


@pytest.mark.parametrize("title", ["PoseRefiner", "BundleAdjuster"])
def test_skew_is_ignored(title: str) -> None:
    inputs = CASES[title].inputs(1, 30, torch.float64)
    skewed = inputs | {"K": change_value(inputs["K"], (0, 1), 5.0)}
    assert_same(CASES[title].function(**skewed), CASES[title].function(**inputs))


CAMERA_INPUTS = [(title, name) for title, case in CAMERA_CASES.items() for name in case.inputs(1, 8, torch.float64)]


@pytest.mark.parametrize(("title", "name"), CAMERA_INPUTS)
def test_array_instead_of_a_tensor_is_rejected(title: str, name: str) -> None:
    inputs = CASES[title].inputs(1, 8, torch.float64)
    with pytest.raises(v3d.InputError, match=rf"^{name} (is of|has the) type .*; give"):
        CASES[title].function(**inputs | {name: inputs[name].numpy()})  # type: ignore[dict-item]


@pytest.mark.parametrize("name", ["pixel_sigma", "inverse_depth_sigma"])
@pytest.mark.parametrize("title", ["PoseRefiner", "BundleAdjuster", "ReadoutEstimator"])
def test_array_of_standard_deviations_is_rejected(title: str, name: str) -> None:
    inputs = CASES[title].inputs(1, 8, torch.float64)
    with pytest.raises(v3d.InputError, match=rf"^{name} is of type ndarray; give a torch.Tensor"):
        CASES[title].function(**inputs | {name: inputs["inverse_depth"].numpy()})  # type: ignore[dict-item]


# ---------------------------------------------------------------- traces


NOT_TRACED = {"DBSCAN", "DescriptorMatcher", "ate"}
TRACED = {
    name: case
    for name, case in (CASES | FUNCTION_CASES).items()
    if name not in {*NOT_TRACED, "align_depth"} and not case.sampled
}


def trace(case: Case, inputs: Inputs) -> Callable[..., tuple[Tensor, ...]]:
    def function(*arguments: Tensor) -> tuple[Tensor, ...]:
        return tensors(case.function(**dict(zip(inputs, arguments, strict=True))))

    traced: Callable[..., tuple[Tensor, ...]] = torch.jit.trace(function, tuple(inputs.values()), check_trace=False)
    return traced


@pytest.mark.filterwarnings("ignore")  # deprecation of torch.jit, and each shape that is checked
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("case", TRACED.values(), ids=TRACED)
def test_trace_gives_the_result_for_other_values(case: Case, dtype: torch.dtype) -> None:
    """The traces had the results for the example, and sometimes whatever was in its memory later."""
    inputs = case.inputs(3, 12, dtype)
    others = {name: each.flip(0) for name, each in inputs.items()}
    found = trace(case, inputs)(*others.values())
    for one, other in zip(found, tensors(case.function(**others)), strict=True):
        torch.testing.assert_close(without_padding(one, other), other, rtol=1e-4, atol=1e-4, equal_nan=True)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", sorted(NOT_TRACED))
def test_trace_of_steps_that_depend_on_sizes_is_rejected(name: str) -> None:
    case = (CASES | FUNCTION_CASES)[name]
    with pytest.raises(v3d.InputError, match=r"^torch.jit.trace cannot record \w+; use torch.export.export$"):
        trace(case, case.inputs(2, 12, torch.float64))


# ---------------------------------------------------------------- gradients


def with_gradients(case: Case, inputs: Inputs) -> Callable[..., tuple[Tensor, ...]]:
    """The module as a function from its differentiable arguments to the results with a gradient."""

    def function(*arguments: Tensor) -> tuple[Tensor, ...]:
        result = case.module(**(inputs | dict(zip(case.differentiable, arguments, strict=True))))
        return tuple(tensor for tensor in tensors(result) if tensor.requires_grad)

    return function


@pytest.mark.parametrize(
    "case",
    [i for i in CASES.values() if i.differentiable and i.gradcheck],
    ids=[n for n, i in CASES.items() if i.differentiable and i.gradcheck],
)
def test_gradcheck(case: Case) -> None:
    inputs = case.inputs(1, 6, torch.float64)
    arguments = [inputs[name].requires_grad_() for name in case.differentiable]
    if case.inputs is image:
        # Depth has a kink at 0, so only measured pixels are checked.
        arguments = [inputs["depth"].detach().clamp(min=1).requires_grad_()]
    assert torch.autograd.gradcheck(with_gradients(case, inputs), arguments)


@each_differentiable
def test_padding_has_no_gradient(case: Case) -> None:
    inputs = fill(case.inputs(4, 20, torch.float64), case.masks, torch.nan)
    arguments = [inputs[name].requires_grad_() for name in case.differentiable]
    results = with_gradients(case, inputs)(*arguments)
    torch.stack([tensor.nan_to_num().sum() for tensor in results]).sum().backward()
    for name, argument in zip(case.differentiable, arguments, strict=True):
        assert argument.grad is not None and argument.grad.isfinite().all() and argument.grad.any()
        if name in case.masks:
            assert not argument.grad[~inputs[case.masks[name]]].any()


DIFFERENTIABLE = {name: case for name, case in (CASES | FUNCTION_CASES).items() if case.differentiable}

IMPLICIT = {"EssentialRANSAC", "PnPRANSAC", "PoseRefiner", "BundleAdjuster", "PoseGraphOptimiser"}
"""Solvers that compute Jacobians in forward mode; torch cannot nest these in its dual levels, only in `torch.func`."""


ARGUMENTS = [(title, name) for title, case in DIFFERENTIABLE.items() for name in case.differentiable]


def with_direction(title: str, name: str) -> tuple[Callable[[Tensor], tuple[Tensor, ...]], Tensor, Tensor]:
    """A function of one of its arguments, the value of the argument, and a direction in which it changes."""
    case = DIFFERENTIABLE[title]
    inputs = case.inputs(2, 12, torch.float64)

    def function(argument: Tensor) -> tuple[Tensor, ...]:
        return tensors(case.function(**inputs | {name: argument}))

    return function, inputs[name], random(*inputs[name].shape, dtype=torch.float64, seed=3) - 0.5


@pytest.mark.parametrize(("title", "name"), [each for each in ARGUMENTS if each[0] in IMPLICIT])
def test_second_derivative_of_an_optimum_is_an_error(title: str, name: str) -> None:
    """It was that of a step with a constant Hessian."""
    inputs = CASES[title].inputs(1, 12, torch.float64)
    inputs[name].requires_grad_()
    loss = tensors(CASES[title].function(**inputs))[0].square().sum()
    (gradient,) = torch.autograd.grad(loss, inputs[name], create_graph=True)
    (alone,) = torch.autograd.grad(tensors(CASES[title].function(**inputs))[0].square().sum(), inputs[name])
    torch.testing.assert_close(gradient, alone, rtol=1e-4, atol=1e-5)
    with pytest.raises(v3d.InputError, match=r"^the optimum of a solver has no second derivatives"):
        torch.autograd.grad(gradient.square().sum(), inputs[name])


@pytest.mark.parametrize(("title", "name"), [each for each in ARGUMENTS if each[0] in IMPLICIT])
def test_solvers_reject_the_dual_levels_of_torch(title: str, name: str) -> None:
    function, argument, direction = with_direction(title, name)
    with (
        forward_ad.dual_level(),
        pytest.raises(RuntimeError, match="Nested forward mode AD is not supported"),
    ):
        function(forward_ad.make_dual(argument, direction))


@pytest.mark.parametrize(("title", "name"), [each for each in ARGUMENTS if each[0] in IMPLICIT])
def test_jvp_of_solvers_is_the_adjoint_of_vjp(title: str, name: str) -> None:
    """The test files of the solvers compare gradients, which are those of vjp, with finite differences."""
    function, argument, direction = with_direction(title, name)

    def results(argument: Tensor) -> Tensor:
        numbers = [each.flatten() for each in function(argument) if each.is_floating_point()]
        return torch.cat(numbers).nan_to_num()

    value, tangent = torch.func.jvp(results, (argument,), (direction,))
    cotangent = random(*value.shape, dtype=torch.float64, seed=4) - 0.5
    (gradient,) = torch.func.vjp(results, argument)[1](cotangent)
    assert tangent.any()
    torch.testing.assert_close((tangent * cotangent).sum(), (direction * gradient).sum(), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(("title", "name"), [each for each in ARGUMENTS if each[0] not in IMPLICIT])
def test_tangent_of_forward_mode_differentiation_equals_jvp(title: str, name: str) -> None:
    function, argument, direction = with_direction(title, name)
    with forward_ad.dual_level():
        found = [
            forward_ad.unpack_dual(result).tangent for result in function(forward_ad.make_dual(argument, direction))
        ]
    values, expected = torch.func.jvp(function, (argument,), (direction,))
    for value, one, other in zip(values, found, expected, strict=True):
        assert other[value.isfinite()].isfinite().all()
        torch.testing.assert_close(torch.zeros_like(other) if one is None else one, other, equal_nan=True)
    assert any(other.any() for other in expected)


@pytest.mark.parametrize(
    ("title", "few", "many", "limit"),
    [
        ("PoseRefiner", {"rounds": 1, "iterations": 1}, {"rounds": 8, "iterations": 50}, 200),
        ("BundleAdjuster", {"iterations": 1}, {"iterations": 30}, 300),
        ("PoseGraphOptimiser", {"iterations": 1}, {"iterations": 30}, 300),
    ],
)
def test_memory_of_the_gradient_does_not_grow_with_the_iterations(
    title: str, few: dict[str, int], many: dict[str, int], limit: int
) -> None:
    inputs = CASES[title].inputs(1, 24, torch.float64)
    inputs["weights"].requires_grad_()
    nodes = [
        count_graph_nodes(tensors(CASES[title].function(**inputs, **iterations, tolerance=0.0))[0])
        for iterations in (few, many)
    ]
    assert 0 < nodes[0] == nodes[1] < limit


@pytest.mark.parametrize(
    ("function", "make"),
    [(v3d.refine_pose, camera_inputs.view), (v3d.bundle_adjust, camera_inputs.bundle)],
    ids=["refine_pose", "bundle_adjust"],
)
def test_gradient_mode_does_not_change_the_result(function: Callable[..., object], make: Make) -> None:
    inputs = make(3, 40, torch.float64)
    inputs["uv"][:, ::5] += 4.0  # where Huber's kernel is linear
    plain = function(**inputs)
    tracked = function(**inputs | {"weights": inputs["weights"].requires_grad_()})
    for one, other in zip(tensors(tracked), tensors(plain), strict=True):
        torch.testing.assert_close(one.detach(), other, rtol=1e-9, atol=1e-9)


def test_smoothing_has_no_gradient_at_missing_depth() -> None:
    depth = image(2, 0, torch.float64)["depth"].requires_grad_()
    v3d.smooth_depth(depth).sum().backward()
    assert depth.grad is not None and torch.equal(depth.grad != 0, depth > 0)


def test_thresholds_of_the_soft_vote_are_differentiable() -> None:
    inputs = centroids(2, 6, torch.float64)
    settings = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.2, 0.1)]

    def votes(distance_threshold: Tensor, temperature: Tensor) -> Tensor:
        return v3d.hough_vote(
            **inputs, distance_threshold=distance_threshold, vote_threshold=2, temperature=temperature
        )[0]

    assert torch.autograd.gradcheck(votes, settings)
    module = v3d.HoughVoting(torch.nn.Parameter(torch.tensor(0.2)), 2, torch.nn.Parameter(torch.tensor(0.1)))
    assert dict(module.named_parameters()).keys() == {"distance_threshold", "temperature"}


def parameter(value: float) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.tensor(value, dtype=torch.float64))


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("soft HoughVoting", v3d.HoughVoting(parameter(0.2), 2, parameter(0.1))),
        ("PoseRefiner", v3d.PoseRefiner(parameter(1.0), parameter(0.02), rounds=1)),
        ("BundleAdjuster", v3d.BundleAdjuster(parameter(1.0), parameter(0.02))),
        ("ReadoutEstimator", v3d.ReadoutEstimator(parameter(1.0), parameter(0.02))),
        ("RollingShutterCompensation", v3d.RollingShutterCompensation(parameter(0.02), 480)),
    ],
)
def test_parameters_of_modules_have_gradients(name: str, module: torch.nn.Module) -> None:
    result = module(**CASES[name].inputs(1, 30, torch.float64))
    result[0].sum().backward()
    for each_parameter in module.parameters():
        assert each_parameter.grad is not None and each_parameter.grad.isfinite() and each_parameter.grad != 0


def test_gradients_flow_from_pixels_to_votes() -> None:
    """Depth of two frames is smoothed, back-projected and pooled; clouds are compared, and centroids vote."""
    depth = torch.stack([image(1, 0, torch.float64)["depth"][0], image(2, 0, torch.float64)["depth"][1]])
    depth.requires_grad_()
    points = v3d.BackProjector(CAMERA)(v3d.DepthSmoother()(depth)).flatten(1, 2)
    column = torch.arange(CAMERA.width).repeat(CAMERA.height)
    masks = torch.stack([column // 4 == k for k in range(3)])  # three adjacent objects
    measured = (depth[:, 0].detach() > 0).flatten(1)
    pooled = v3d.VoxelPool(0.05)(points.repeat_interleave(3, dim=0), (measured[:, None] & masks).flatten(0, 1))
    clouds, valid = pooled.means.unflatten(0, (2, 3)), pooled.valid.unflatten(0, (2, 3))
    centroid = clouds.sum(dim=2) / valid.sum(dim=2, keepdim=True)
    vote = v3d.HoughVoting(0.02, 1, temperature=0.02)
    votes = vote(centroid[0], centroid[1], torch.ones(3, dtype=torch.bool))
    change = v3d.ChamferDistance()(clouds[0], clouds[1], valid[0], valid[1])
    for loss in (votes.votes.sum(), change.sum()):
        (gradient,) = torch.autograd.grad(loss, depth, retain_graph=True)
        assert gradient.isfinite().all() and gradient.any()
        assert not gradient[depth <= 0].any()


# ---------------------------------------------------------------- instance tracking


def boxes(count: int, shift: float, dtype: torch.dtype) -> tuple[v3d.Instances, InstanceClouds, Tensor]:
    """Objects on a grid of 0.3 m in front of a wall, shifted to the right: instances, clouds and depth."""
    camera = TRACKED
    place = torch.stack([torch.arange(count) % 10, torch.arange(count) // 10], dim=1).to(dtype) * 0.3 - 1.4
    corner = torch.cartesian_prod(*[torch.tensor([-0.08, 0.0, 0.08], dtype=dtype)] * 2)
    xy = place[:, None] + corner + torch.tensor([shift, 0.0], dtype=dtype)
    points = torch.cat([xy, torch.full((count, 9, 1), 2.0, dtype=dtype)], dim=2)
    uv = camera.project(points)
    low, high = uv.amin(dim=1), uv.amax(dim=1)
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    inside = (u >= low[:, :1, None]) & (u <= high[:, :1, None]) & (v >= low[:, 1:, None]) & (v <= high[:, 1:, None])
    depth = torch.where(inside.any(dim=0), 2.0, 4.0).to(dtype)[None]
    instances = v3d.Instances(inside, torch.zeros(count, dtype=torch.int64), torch.ones(count), torch.zeros(count, 4))
    clouds = InstanceClouds(points, torch.ones(count, 9, dtype=torch.bool), points.mean(dim=1), inside)
    return instances, clouds, depth


TRACKED = v3d.PinholeCamera(fx=100.0, fy=100.0, cx=79.5, cy=79.5, width=160, height=160)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("batch", "count"), list(product((0, 1, 3), (0, 1, 100))))
def test_match_instances_in_batches(batch: int, count: int, dtype: torch.dtype) -> None:
    """Objects that were shuffled; some tracks and some instances are missing."""
    order = random(batch, count, dtype=torch.float64, seed=6).argsort(dim=1)
    tracked, present = random_mask(batch, count), random_mask(batch, count, 7)
    ratio = random(batch, count, count, dtype=dtype) - 1
    ratio.scatter_(2, order[..., None], 1.0)  # instance of each track
    matched = v3d.match_instances(ratio, tracked, present)
    expected = order.argsort(dim=1)  # track of each instance
    known = present & tracked.gather(1, expected)
    assert matched.dtype == torch.int64 and torch.equal(matched, torch.where(known, expected, -1))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [0, 1, 100])
def test_instance_tracker_keeps_ids(count: int, dtype: torch.dtype) -> None:
    track = v3d.InstanceTracker(v3d.Config().objects.tracker, TRACKED, v3d.Config().objects.clouds)
    here = torch.eye(4, dtype=torch.float64)
    for frame in range(3):
        instances, clouds, depth = boxes(count, 0.05 * frame, dtype)
        tracks = track(frame / 30, instances, clouds, depth, here)
        assert [t.id for t in tracks] == list(range(1, count + 1))  # neighbours keep their ids
    for t, centroid in zip(tracks, clouds.centroid, strict=True):
        assert t.newest.cloud.dtype == dtype
        torch.testing.assert_close(t.newest.centroid, centroid.double())
    no_instances, no_clouds, _ = boxes(0, 0.0, dtype)
    missed = track(0.1, no_instances, no_clouds, boxes(count, 0.15, dtype)[2], here)
    assert len(missed) == count and all(t.missed and t.mask.any() for t in missed)
