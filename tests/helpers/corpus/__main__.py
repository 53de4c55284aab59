"""Print a table of the cases and their expected ends: ``python -m helpers.corpus`` in ``tests``."""

from __future__ import annotations

from helpers.corpus import CATEGORIES
from helpers.corpus.case import Fails, Succeeds

print("| | cases | right result | error message | with partial results |")
print("|---|---:|---:|---:|---:|")
rows = [(name, [case.expected for case in cases]) for name, cases in CATEGORIES.items()]
for name, ends in [*rows, ("all", [end for _, each in rows for end in each])]:
    right = sum(isinstance(end, Succeeds) for end in ends)
    kept = sum(isinstance(end, Fails) and end.saved_poses is not None for end in ends)
    print(f"| {name} | {len(ends)} | {right} | {len(ends) - right} | {kept} |")
