"""The package as a whole: public names, import time, direction of imports, size of its root."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator, Set
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import v3d_torch

ROOT = Path(v3d_torch.__file__).parent

LAYERS = (
    *(
        "errors",
        "io",
        "kernels",
        "config",
        "geometry",
        "types",
        "runtime",
        "optim",
        "features",
        "datasets",
        "segmentation",
    ),
    *("objects", "odometry", "mapping", "tracking", "backend", "reconstruction", "occupancy", "evaluation"),
    *(
        "calibration",
        "frame_result",
        "stages",
        "slam",
        "live",
        "pipeline",
        "viz",
        "export",
        "runs",
        "batch",
        "cli",
        "run",
        "__main__",
    ),
)
"""Folders and modules of the package's root, from low to high: a layer imports only from itself and lower layers."""

MAX_ROOT_FILES = 10


def test_contributing_lists_the_layers_in_their_order() -> None:
    text = (ROOT.parent / "CONTRIBUTING.md").read_text()
    table = text[text.index("| folder of `v3d_torch` |") : text.index("[docs/design.md]")]
    names = [f"`{name}/`" if (ROOT / name).is_dir() else f"`{name}.py`" for name in LAYERS]
    places = [table.find(name) for name in names]
    assert min(places) > 0 and places == sorted(places)


def test_stub_lists_every_public_name() -> None:
    stub = ast.parse((ROOT / "__init__.pyi").read_text())
    (listed,) = (ast.literal_eval(node.value) for node in stub.body if isinstance(node, ast.Assign))
    assert sorted(listed) == sorted(v3d_torch.__all__) == sorted(dir(v3d_torch))
    for name in listed:
        assert getattr(v3d_torch, name).__module__.startswith("v3d_torch.")
    with pytest.raises(AttributeError, match="nonsense"):
        v3d_torch.nonsense  # noqa: B018


COMMANDS = [f"v3d_torch.cli.{path.stem}" for path in ROOT.glob("cli/[!_]*.py") if not path.stem.endswith("_command")]
"""Modules that parse options. Those with the suffix ``_command`` are imported after the options are parsed."""


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        (["v3d_torch", "v3d_torch.batch.progress_board", *COMMANDS], {"torch", "cv2", "scipy", "numpy"}),
        # The state of pyplot is global, and without a viewer the import of rerun would be for nothing.
        (["v3d_torch.runs.open_sequences", "v3d_torch.runs.report_page"], {"matplotlib.pyplot", "rerun"}),
    ],
    ids=["commands", "runs and reports"],
)
def test_import_loads_no_heavy_library(modules: list[str], heavy: set[str]) -> None:
    code = f"""
import importlib, sys
for module in {modules}:
    importlib.import_module(module)
    for library in {heavy} & set(sys.modules):
        print(module, "imports", library)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout == ""


def test_package_that_is_first_used_in_inference_mode_can_be_trained() -> None:
    code = """
import torch, v3d_torch as v3d
with torch.inference_mode():
    v3d.se3_exp(torch.zeros(6))
uv = (100 * torch.rand(20, 2)).requires_grad_()
v3d.se3_log(v3d.refine_pose(torch.eye(4), torch.rand(20, 3) + 1, uv, torch.eye(3)).T_cw).sum().backward()
print(uv.grad is not None)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)  # noqa: S603
    assert done.stdout.strip() == "True", done.stderr


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Modules of the package that each of its modules imports at module level."""
    files = {module_name(path): path for path in ROOT.rglob("*.py")}
    return {name: set(imported_modules(path, files.keys())) for name, path in files.items()}


def test_imports_have_no_cycle(imports: dict[str, set[str]]) -> None:
    assert sum(map(len, imports.values())) > len(imports)
    assert len(list(TopologicalSorter(imports).static_order())) == len(imports)  # CycleError names a cycle


def test_modules_import_only_from_their_own_or_lower_layers(imports: dict[str, set[str]]) -> None:
    levels = {layer: level for level, layer in enumerate(LAYERS)}
    upward = [
        f"{name} imports {imported}"
        for name, modules in sorted(imports.items())
        for imported in sorted(modules - {"v3d_torch"})
        if name != "v3d_torch" and levels[layer_of(imported)] > levels[layer_of(name)]
    ]
    assert upward == []


def test_layers_are_the_folders_and_modules_of_the_root(imports: dict[str, set[str]]) -> None:
    assert {layer_of(name) for name in imports if name != "v3d_torch"} == set(LAYERS)


def test_root_has_few_files() -> None:
    files = [path.name for path in ROOT.iterdir() if path.is_file()]
    assert len(files) <= MAX_ROOT_FILES, files


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")


def layer_of(module: str) -> str:
    """Folder or module of the package's root that a module belongs to."""
    return module.split(".")[1]


def imported_modules(path: Path, modules: Set[str]) -> Iterator[str]:
    """Modules of the package that a file imports at module level: not in functions, nor for type checkers only."""
    pending: list[ast.AST] = [ast.parse(path.read_text())]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from {name if name in modules else str(node.module) for name in names} & modules
        elif isinstance(node, ast.Import):
            yield from {alias.name for alias in node.names} & modules
        elif not isinstance(node, ast.FunctionDef) and not is_for_type_checkers(node):
            pending.extend(ast.iter_child_nodes(node))


def is_for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
