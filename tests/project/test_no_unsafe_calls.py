"""Safety of downloads, of loaded files and of dependencies: fixed hosts, no code from data, known licences."""

from __future__ import annotations

import ast
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import v3d_torch
from v3d_torch.datasets.sequence_names import SEQUENCES, canonical_name, download_url
from v3d_torch.io import safe_yaml
from v3d_torch.segmentation.weights import REGISTRY

PACKAGE = Path(v3d_torch.__file__).parent
ROOT = PACKAGE.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))

HOSTS = {"github.com", "cvg.cit.tum.de"}
"""Hosts of all downloads, except those of pip."""

EXCEPTIONS = Counter(
    {
        ("io/download.py", "S310"): 1,  # opens a URL after `fetch` has checked that it is https
        ("io/safe_yaml.py", "S506"): 1,  # uses its own loader, a subclass of the safe one
        ("runs/kernel_compilation.py", "S603"): 1,  # runs this program itself to compile kernels
        ("segmentation/weights.py", "S603"): 1,  # runs pip, with arguments from the registry
        ("viz/rerun/stream.py", "S603"): 1,  # starts the viewer, which outlives the run
    }
)
"""Exceptions from the security rules of ruff (flake8-bandit) in the package."""


def sources() -> Iterator[tuple[str, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8")


def test_downloads_are_from_fixed_hosts_over_https() -> None:
    addresses = [published.url for published in REGISTRY.values()] + [download_url(name) for name in SEQUENCES]
    assert len(addresses) > 40
    assert {urlsplit(address).scheme for address in addresses} == {"https"}
    assert {urlsplit(address).netloc for address in addresses} == HOSTS
    assert all(urlsplit(published.url).path.startswith("/ultralytics/assets/") for published in REGISTRY.values())
    assert all(len(published.sha256) == 64 and published.size > 0 for published in REGISTRY.values())


def test_code_contains_no_other_address() -> None:
    """The only address without https is that of the viewer, on the same machine."""
    hosts = set()
    for name, source in sources():
        for text in strings(source):
            for address in re.findall(r"\b[\w+]+://[^\s\"'<>]+", text):
                hosts.add((urlsplit(address).scheme, urlsplit(address).hostname, name))
    assert {(scheme, host) for scheme, host, _ in hosts} == {
        *(("https", host) for host in HOSTS),
        ("rerun+http", "127.0.0.1"),
    }, hosts


def strings(source: str) -> Iterator[str]:
    """Return all strings of a source but its docstrings, which are statements of their own."""
    tree = ast.parse(source)
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


def test_addresses_in_messages_are_found_and_those_in_docstrings_are_not() -> None:
    source = '''
"""A module, see https://a.org"""
A = 1
"""An attribute, see https://b.org"""
raise ValueError(f"{A}: is too large; see https://c.org for the limits")
'''
    found = [address for text in strings(source) for address in re.findall(r"https://[^ ]+", text)]
    assert found == ["https://c.org"]


@pytest.mark.parametrize(
    "name", ["fr3/w/xyz@example.org", "../../example.org/a", "https://example.org/a", "fr1/desk?x"]
)
def test_sequence_names_cannot_change_the_download_host(name: str) -> None:
    assert canonical_name(name) is None


@pytest.mark.parametrize(
    "name", ["fr3/w/xyz", " FR3\\W\\XYZ/", "../../fr1/desk", "walking_rpy", "tum.freiburg3-office-val"]
)
def test_other_spellings_of_sequence_names_have_the_same_download_host(name: str) -> None:
    full = canonical_name(name)
    assert full in SEQUENCES and urlsplit(download_url(full)).netloc == "cvg.cit.tum.de"


def test_security_rules_are_enabled_with_known_exceptions() -> None:
    lint = PROJECT["tool"]["ruff"]["lint"]
    assert "S" in lint["select"] and not [rule for rule in lint["ignore"] if re.match(r"S\d", rule)]
    assert {
        rule: where
        for where, rules in lint["per-file-ignores"].items()
        for rule in rules
        if re.match(r"S\d", rule) and where not in ("tests/**", "notebooks/**")
    } == {}
    found = Counter(
        (name, rule) for name, source in sources() for line in source.splitlines() for rule in disabled_rules(line)
    )
    assert found == EXCEPTIONS


def disabled_rules(line: str) -> list[str]:
    """Security rules that a ``noqa`` comment disables; "S" if the comment disables all rules."""
    comment = re.search(r"#\s*noqa(?::\s*([A-Z0-9, ]+))?", line)
    if comment is None:
        return []
    return re.findall(r"\bS\d{3}\b", comment[1]) if comment[1] else ["S"]


def test_yaml_loader_is_safe() -> None:
    assert issubclass(safe_yaml._StrictLoader, yaml.SafeLoader)


def test_pickles_are_only_loaded_with_weights_only() -> None:
    calls = [(name, call) for name, source in sources() for call in pickle_loads(source)]
    assert sorted(name for name, _ in calls) == ["io/state_file.py", "segmentation/pt_weights.py"]
    assert all("weights_only=True" in call for _, call in calls)


PICKLE_LOADER = re.compile(
    r"(_?pickle|dill|cloudpickle|joblib|marshal|shelve|torch|numpy)\.(\w+\.)*(loads?|Unpickler|open)"
    r"|pandas\.(\w+\.)*read_pickle"
)
"""Full names of functions that can load pickles."""


def pickle_loads(source: str) -> list[str]:
    """Return the calls of a source that can load pickles, under any name that it imports."""
    tree = ast.parse(source)
    modules = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {each.asname: each.name for each in node.names if each.asname}
        elif isinstance(node, ast.ImportFrom):
            modules |= {each.asname or each.name: f"{node.module}.{each.name}" for each in node.names}
    calls = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, *others = ast.unparse(node.func).split(".")
            name = ".".join([modules.get(first, first), *others])
            allowed = [each.value for each in node.keywords if each.arg == "allow_pickle"]
            if PICKLE_LOADER.fullmatch(name) or any(ast.unparse(each) != "False" for each in allowed):
                calls.append(ast.unparse(node))
    return calls


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("import pickle\npickle.loads(b'')", 1),
        ("import pickle as p\np.Unpickler(file).load()", 1),
        ("from torch import load\nload(path)", 1),
        ("from torch import load as read\nread(path)", 1),
        ("from torch import jit\njit.load(path)", 1),
        ("import numpy as other\nother.load(path, allow_pickle=True)", 1),
        ("from somewhere import read\nread(path, allow_pickle=flag)", 1),
        ("from somewhere import read\nread(path, allow_pickle=False)", 0),
        ("import json\njson.loads('')", 0),
        ("import onnx\nonnx.load(path)", 0),
    ],
)
def test_loaders_of_pickles_are_found_under_any_name(source: str, count: int) -> None:
    assert len(pickle_loads(source)) == count


# --- licences


def requirements() -> dict[str, set[str]]:
    """Packages in pyproject.toml by extra; required packages under the empty name."""
    extras = {"": PROJECT["project"]["dependencies"], **PROJECT["project"]["optional-dependencies"]}
    packages = {extra: {canonicalize_name(Requirement(line).name) for line in lines} for extra, lines in extras.items()}
    return {extra: names - {"v3d-torch"} for extra, names in packages.items()}


def licence_page() -> dict[str, dict[str, str]]:
    """Sections of docs/licences.md: packages and their licences."""
    page = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    return {
        section.partition("\n")[0]: dict(re.findall(r"^\| \**([\w-]+)\** \| (.+) \|$", section, re.MULTILINE))
        for section in page.split("\n## ")[1:]
    }


def test_licence_of_every_dependency_is_listed() -> None:
    """The page is generated by python docs/hooks/licences.py > docs/licences.md."""
    sections = licence_page()
    everything = {name for packages in sections.values() for name in packages}
    assert requirements()[""] <= sections["To run"].keys()
    assert set().union(*requirements().values()) - {"setuptools"} <= everything
    assert all(licence != "not installed here" for packages in sections.values() for licence in packages.values())


def test_required_packages_have_no_copyleft_licence() -> None:
    required = licence_page()["To run"]
    assert not [name for name, licence in required.items() if re.search(r"GPL|MPL|EUPL|CC-BY-SA|SSPL", licence)]
