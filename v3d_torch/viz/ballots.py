"""The lines between objects that voted for each other."""

from __future__ import annotations

from collections.abc import Collection, Iterable

Pair = tuple[int, int]
"""Ids of two objects, the smaller first."""


def lines_of(ballots: Iterable[tuple[int, int]], dynamic: Collection[int]) -> tuple[list[Pair], list[Pair]]:
    """The pairs of objects of which at least one voted for the other, each once.

    Args:
        ballots: ids of who voted and for whom.
        dynamic: ids of what is dynamic.

    Returns:
        Pairs with a vote for what is dynamic, and those whose votes came to nothing, both sorted.
    """
    ballots = list(ballots)
    counted = {(min(ballot), max(ballot)) for ballot in ballots if ballot[1] in dynamic}
    return sorted(counted), sorted({(min(ballot), max(ballot)) for ballot in ballots} - counted)
