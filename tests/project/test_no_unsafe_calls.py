"""What the package downloads, opens and depends on: fixed hosts, no code out of data, licences known."""

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
from v3d_torch.io import safe_yaml as plain_yaml
from v3d_torch.segmentation.weights import REGISTRY

PACKAGE = Path(v3d_torch.__file__).parent
ROOT = PACKAGE.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))

HOSTS = {"github.com", "cvg.cit.tum.de"}
"""All that is downloaded from, besides what pip is told to ask."""

EXCEPTIONS = Counter(
    {
        ("download.py", "S310"): 1,  # opens an address, once `fetch` has seen that it is https
        ("plain_yaml.py", "S506"): 1,  # a loader of its own, which is a safe one
        ("second_process.py", "S603"): 1,  # this program itself, to look at frames
        ("segmentation/weights.py", "S603"): 1,  # runs pip, with arguments from the registry
        ("viz/rerun/stream.py", "S603"): 1,  # starts the viewer, which is to outlive the run
    }
)
"""Where the package does what ruff's security rules (flake8-bandit's) forbid."""


def sources() -> Iterator[tuple[str, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8")


def test_everything_is_downloaded_from_fixed_hosts_over_https() -> None:
    addresses = [published.url for published in REGISTRY.values()] + [download_url(name) for name in SEQUENCES]
    assert len(addresses) > 40
    assert {urlsplit(address).scheme for address in addresses} == {"https"}
    assert {urlsplit(address).netloc for address in addresses} == HOSTS
    assert all(urlsplit(published.url).path.startswith("/ultralytics/assets/") for published in REGISTRY.values())
    assert all(len(published.sha256) == 64 and published.size > 0 for published in REGISTRY.values())


def test_no_other_address_is_in_the_code() -> None:
    """Nor one without https but for the viewer's, on the same machine."""
    hosts = set()
    for name, source in sources():
        documented = {id(node.body[0].value) for node in ast.walk(ast.parse(source)) if is_documented(node)}
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in documented:
                for address in re.findall(r"\b[\w+]+://[^\s\"'<>]+", node.value):
                    if not is_prose(node.value):
                        hosts.add((urlsplit(address).scheme, urlsplit(address).hostname, name))
    assert {(scheme, host) for scheme, host, _ in hosts} - {("https", host) for host in HOSTS} <= {
        ("rerun+http", "127.0.0.1")
    }, hosts


def is_documented(node: ast.AST) -> bool:
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    return isinstance(node, kinds) and ast.get_docstring(node) is not None


def is_prose(text: str) -> bool:
    """Docstrings, also those of attributes."""
    return len(text.split()) > 3


@pytest.mark.parametrize(
    "name", ["fr3/w/xyz@example.org", "../../example.org/a", "https://example.org/a", "fr1/desk?x"]
)
def test_a_name_cannot_lead_elsewhere(name: str) -> None:
    full = canonical_name(name)
    assert full is None or urlsplit(download_url(full)).netloc == "cvg.cit.tum.de"


def test_security_rules_are_on_and_the_exceptions_are_known() -> None:
    lint = PROJECT["tool"]["ruff"]["lint"]
    assert "S" in lint["select"] and not [rule for rule in lint["ignore"] if re.match(r"S\d", rule)]
    assert {
        rule: where
        for where, rules in lint["per-file-ignores"].items()
        for rule in rules
        if re.match(r"S\d", rule) and where not in ("tests/**", "notebooks/**")
    } == {}
    found = Counter(
        (name, rule) for name, source in sources() for line in source.splitlines() for rule in allowed(line)
    )
    assert found == EXCEPTIONS


def allowed(line: str) -> list[str]:
    """Security rules that a line is let off; all of them, where it does not say which."""
    comment = re.search(r"#\s*noqa(?::\s*([A-Z0-9, ]+))?", line)
    if comment is None:
        return []
    return re.findall(r"\bS\d{3}\b", comment[1]) if comment[1] else ["S"]


def test_yaml_is_read_by_a_safe_loader() -> None:
    assert issubclass(plain_yaml._PlainLoader, yaml.SafeLoader)


def test_pickles_are_opened_by_torchs_restricted_reader_alone() -> None:
    calls = [
        (name, ast.unparse(node))
        for name, source in sources()
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and re.fullmatch(r"(pickle|torch|np|numpy|joblib)\.loads?", ast.unparse(node.func))
    ]
    assert sorted(name for name, _ in calls) == ["segmentation/checkpoint.py", "state_file.py"]
    assert all("weights_only=True" in call for _, call in calls)


# --- licences


def requirements() -> dict[str, set[str]]:
    """Packages that pyproject.toml names, by extra; those of every run under the empty one."""
    extras = {"": PROJECT["project"]["dependencies"], **PROJECT["project"]["optional-dependencies"]}
    named = {extra: {canonicalize_name(Requirement(line).name) for line in lines} for extra, lines in extras.items()}
    return {extra: names - {"v3d-torch"} for extra, names in named.items()}


def listed() -> dict[str, dict[str, str]]:
    """Sections of the page of licences: packages and what they say."""
    page = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    return {
        section.partition("\n")[0]: dict(re.findall(r"^\| \**([\w-]+)\** \| (.+) \|$", section, re.MULTILINE))
        for section in page.split("\n## ")[1:]
    }


def test_the_licence_of_every_dependency_is_listed() -> None:
    """python docs/hooks/licences.py > docs/licences.md makes the page anew."""
    sections = listed()
    everything = {name for packages in sections.values() for name in packages}
    assert requirements()[""] <= sections["To run"].keys()
    assert set().union(*requirements().values()) - {"setuptools"} <= everything
    assert all(licence != "not installed here" for packages in sections.values() for licence in packages.values())


def test_no_run_needs_a_package_under_copyleft() -> None:
    needed = listed()["To run"]
    assert not [name for name, licence in needed.items() if re.search(r"GPL|MPL|EUPL|CC-BY-SA|SSPL", licence)]
