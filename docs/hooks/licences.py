"""The page of licences: ``python docs/hooks/licences.py > docs/licences.md``, with all extras installed.

What pyproject.toml asks for, and all that this brings, by what the packages say of themselves.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]

SAID_ELSEWHERE = {
    "apsw": "Zlib",  # "any-OSI"; its LICENSE names this one
    "atheris": "Apache-2.0",  # its metadata say nothing
}
"""Licences of packages whose metadata hold none, or a text in its place."""

CLASSIFIERS = {
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "GNU General Public License v3 (GPLv3)": "GPL-3.0",
    "GNU General Public License v3 or later (GPLv3+)": "GPL-3.0-or-later",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
"""Short names."""

HEAD = """# Licences
The code of v3d_torch is under Apache-2.0. Below is what it asks for and what that brings, with the versions of
`constraints.txt` and the licence that each package states. Made by `python docs/hooks/licences.py > docs/licences.md`.

- **Nothing that a run needs is under a copyleft licence.** `ray`, `docs` and `test` bring some under MPL-2.0.
- Tests compare with evo and read files with plyfile: both are under the GPL, and are in the extra `test` alone.
- Wheels hold libraries of others under their own licences, as OpenCV's holds FFmpeg's under the LGPL-2.1: see their
  `*.dist-info` folders.
- The network's weights are under AGPL-3.0. They are not part of this package; a run with the network downloads them."""


def page() -> Iterator[str]:
    """Lines of the page."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    yield HEAD
    needed = brought(project["dependencies"])
    yield from section("To run", project["dependencies"], needed)
    for extra, requirements in project["optional-dependencies"].items():
        requirements = [wanted for wanted in requirements if Requirement(wanted).name != project["name"]]
        more = brought(requirements) - needed
        if more:
            yield from section(f"Extra `{extra}`", requirements, more)


def section(title: str, requirements: Iterable[str], names: Iterable[str]) -> Iterator[str]:
    """A table; what is asked for by name is bold."""
    asked = {canonicalize_name(Requirement(wanted).name) for wanted in requirements}
    yield from ("", f"## {title}", "| package | licence |", "|---|---|")
    for name in sorted(names):
        found = installed(name)
        licence = "not installed here" if found is None else licence_of(found)
        yield f"| {f'**{name}**' if name in asked else name} | {licence} |"


def brought(requirements: Iterable[str]) -> set[str]:
    """Names of the packages that requirements bring, and those that these bring, on this platform."""
    found: set[str] = set()
    pending = [(Requirement(wanted), "") for wanted in requirements]
    while pending:
        wanted, extra = pending.pop()
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(wanted.name)
        package = installed(name)
        if name in found and not wanted.extras:
            continue
        found.add(name)
        for more in package.requires or () if package is not None else ():
            pending += [(Requirement(more), asked) for asked in (wanted.extras or {""})]
    return found


def installed(name: str) -> Distribution | None:
    """A package that is here."""
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def licence_of(package: Distribution) -> str:
    """By its expression, its classifiers, or a field of one line."""
    metadata = package.metadata
    name = canonicalize_name(metadata["Name"])
    classifiers = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or [] if "License ::" in line]
    short = [CLASSIFIERS[line] for line in classifiers if line in CLASSIFIERS]
    said = (metadata.get("License") or "").strip()
    stated = metadata.get("License-Expression") or SAID_ELSEWHERE.get(name) or " and ".join(short) or said
    if not stated or re.search(r"\n|UNKNOWN", stated):
        raise SystemExit(f"{name}: says no licence; look it up and add it to SAID_ELSEWHERE")
    return str(stated)


if __name__ == "__main__":
    sys.stdout.write("\n".join(page()) + "\n")
