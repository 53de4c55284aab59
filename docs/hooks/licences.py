"""Writes the page of licences: ``python docs/hooks/licences.py > docs/licences.md``, with all extras installed.

The page lists the requirements of pyproject.toml and their dependencies, with the licences that the packages state.
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

LICENCES_BY_HAND = {
    "apsw": "Zlib",  # its metadata states "any-OSI", its LICENSE file Zlib
    "atheris": "Apache-2.0",  # not in its metadata
    "openexr": "BSD-3-Clause",  # not in its metadata
}
"""Licences of packages without a licence name in their metadata."""

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
"""Short names of licences by classifier."""

HEAD = """# Licences
The code of v3d_torch is under Apache-2.0. This page lists its requirements and their dependencies, in the versions of
`constraints.txt`, with the licence that each package states. `python docs/hooks/licences.py > docs/licences.md` writes
it.

- **No package that a run needs is under a copyleft licence.** The extras `ray`, `docs` and `test` include some under
  MPL-2.0.
- Tests compare with evo and read files with plyfile: both are under the GPL, and only in the extra `test`.
- Wheels can contain other libraries under their own licences, such as FFmpeg under LGPL-2.1 in OpenCV's: see their
  `*.dist-info` folders.
- The weights of the network are under AGPL-3.0. They are not part of this package; a run with the network downloads
  them.
- The test points of ORB (`v3d_torch/features/brief_pattern.csv`) are those of OpenCV, under BSD-3-Clause (Willow
  Garage, 2009). The photographs of the demo are CC0 or in the public domain (`v3d_torch/datasets/assets/README.md`)."""


def page() -> Iterator[str]:
    """Yield the lines of the page."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    yield HEAD
    needed = dependencies(project["dependencies"])
    yield from section("To run", project["dependencies"], needed)
    for extra, requirements in project["optional-dependencies"].items():
        requirements = [wanted for wanted in requirements if Requirement(wanted).name != project["name"]]
        more = dependencies(requirements) - needed
        if more:
            yield from section(f"Extra `{extra}`", requirements, more)


def section(title: str, requirements: Iterable[str], names: Iterable[str]) -> Iterator[str]:
    """Yield a table of packages; direct requirements are bold."""
    direct = {canonicalize_name(Requirement(each).name) for each in requirements}
    yield from ("", f"## {title}", "| package | licence |", "|---|---|")
    for name in sorted(names):
        found = installed(name)
        licence = "not installed here" if found is None else licence_of(found)
        yield f"| {f'**{name}**' if name in direct else name} | {licence} |"


def dependencies(requirements: Iterable[str]) -> set[str]:
    """Return the names of required packages and all their dependencies on this platform."""
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
            pending += [(Requirement(more), name_of_extra) for name_of_extra in (wanted.extras or {""})]
    return found


def installed(name: str) -> Distribution | None:
    """Return an installed package; None if it is not installed."""
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def licence_of(package: Distribution) -> str:
    """Return the licence of a package: its expression, its classifiers, or a field of one line."""
    metadata = package.metadata
    name = canonicalize_name(metadata["Name"])
    classifiers = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or [] if "License ::" in line]
    short = [CLASSIFIERS[line] for line in classifiers if line in CLASSIFIERS]
    field = (metadata.get("License") or "").strip()
    stated = metadata.get("License-Expression") or LICENCES_BY_HAND.get(name) or " and ".join(short) or field
    if not stated or re.search(r"\n|UNKNOWN", stated):
        raise SystemExit(f"{name}: states no licence; find it and add it to LICENCES_BY_HAND")
    return str(stated)


if __name__ == "__main__":
    sys.stdout.write("\n".join(page()) + "\n")
