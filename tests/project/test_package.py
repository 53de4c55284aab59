"""The package as a whole: its public names, how quickly it is there, imports that go in one direction."""

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


def test_every_public_name_is_there() -> None:
    stub = ast.parse((ROOT / "__init__.pyi").read_text())
    (promised,) = (ast.literal_eval(node.value) for node in stub.body if isinstance(node, ast.Assign))
    assert sorted(promised) == sorted(v3d_torch.__all__) == sorted(dir(v3d_torch))
    for name in promised:
        assert getattr(v3d_torch, name).__module__.startswith("v3d_torch.")
    with pytest.raises(AttributeError, match="nonsense"):
        v3d_torch.nonsense  # noqa: B018


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, v3d_torch, v3d_torch.cli.run, v3d_torch.cli.evaluate; print({'torch', 'cv2', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout.strip() == "set()"


def test_imports_go_in_one_direction() -> None:
    files = {module_name(path): path for path in ROOT.rglob("*.py")}
    graph = {name: set(imports(path, files.keys())) for name, path in files.items()}
    assert sum(map(len, graph.values())) > len(graph)
    assert len(list(TopologicalSorter(graph).static_order())) == len(files)  # CycleError names a circle


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")


def imports(path: Path, modules: Set[str]) -> Iterator[str]:
    """Modules of the package that a file imports when it is imported: not in functions, nor for type checkers."""
    pending: list[ast.AST] = [ast.parse(path.read_text())]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from {name if name in modules else str(node.module) for name in names} & modules
        elif isinstance(node, ast.Import):
            yield from {alias.name for alias in node.names} & modules
        elif not isinstance(node, ast.FunctionDef) and not for_type_checkers(node):
            pending.extend(ast.iter_child_nodes(node))


def for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
