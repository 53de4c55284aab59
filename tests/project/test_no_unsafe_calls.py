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
        nodes = list(ast.walk(ast.parse(source)))
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}  # also those of attributes
        for node in nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
                for address in re.findall(r"\b[\w+]+://[^\s\"'<>]+", node.value):
                    hosts.add((urlsplit(address).scheme, urlsplit(address).hostname, name))
    assert {(scheme, host) for scheme, host, _ in hosts} - {("https", host) for host in HOSTS} <= {
        ("rerun+http", "127.0.0.1")
    }, hosts


@pytest.mark.parametrize(
    "name", ["fr3/w/xyz@example.org", "../../example.org/a", "https://example.org/a", "fr1/desk?x"]
)
def test_sequence_names_cannot_change_the_download_host(name: str) -> None:
    assert canonical_name(name) is None


@pytest.mark.parametrize("name", ["fr3/w/xyz", "fr1/desk", "rgbd_dataset_freiburg2_xyz", "fr3_sitting_rpy"])
def test_sequences_are_downloaded_from_the_host_of_the_data_set(name: str) -> None:
    full = canonical_name(name)
    assert full is not None and urlsplit(download_url(full)).netloc == "cvg.cit.tum.de"


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
    calls = [
        (name, ast.unparse(node))
        for name, source in sources()
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and re.fullmatch(r"(pickle|torch|np|numpy|joblib)\.loads?", ast.unparse(node.func))
    ]
    assert sorted(name for name, _ in calls) == ["io/state_file.py", "segmentation/pt_weights.py"]
    assert all("weights_only=True" in call for _, call in calls)


def test_functions_that_unpickle_are_not_imported_under_other_names() -> None:
    for name, source in sources():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.module in ("torch", "numpy", "joblib", "pickle"):
                assert not {each.name for each in node.names} & {"load", "loads", "Unpickler"}, name
            if isinstance(node, ast.Import):
                renamed = {each.name: each.asname for each in node.names if each.asname}
                assert renamed.get("numpy", "np") == "np" and not {"torch", "joblib", "pickle"} & renamed.keys(), name
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert ast.unparse(node.value) == "False", name


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
