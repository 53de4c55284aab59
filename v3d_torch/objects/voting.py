"""Spatial-reasoned Hough voting: which objects move, told without the camera's pose (paper, Sec. III-C, Alg. 1)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.core.check import KORNIA_CHECK_SHAPE
from torch import Tensor


class Votes(NamedTuple):
    r"""Outcome of a vote among K objects.

    Attributes:
        votes: votes received by each object, :math:`V(O_i) = \sum_j I_{ij}`, dtype of the centroids, shape
            :math:`(..., K)`.
        pair: the indicator :math:`I_{ij}`, vote of object j for object i, shape :math:`(..., K, K)`; symmetric, 0 on
            the diagonal and for objects that are not present.
        change: by how much the distance between objects i and j has changed, metres, shape :math:`(..., K, K)`; 0 as
            ``pair``.
        dynamic: objects with enough votes, bool, shape :math:`(..., K)`.
    """

    votes: Tensor
    pair: Tensor
    change: Tensor
    dynamic: Tensor


def hough_vote(
    previous: Tensor,
    current: Tensor,
    present: Tensor,
    distance_threshold: float | Tensor,
    vote_threshold: float | Tensor,
    temperature: float | Tensor | None = None,
) -> Votes:
    r"""Let every object vote for those whose distance to it has changed.

    The distance between two still objects is the same from wherever the camera sees them, so centroids of both times
    stay in the camera frame of their own time and no pose is needed. Row i of both inputs is the same object.

    Args:
        previous: centroids then, metres, shape :math:`(..., K, 3)`.
        current: centroids now, metres, shape :math:`(..., K, 3)`.
        present: objects seen both times, bool, shape :math:`(..., K)`; what stands in other rows is not looked at.
        distance_threshold: :math:`T_d`, metres: a change of at least this is a vote.
        vote_threshold: :math:`T_v`: an object with at least so many votes is dynamic.
        temperature: metres; the indicator becomes :math:`\sigma((change - T_d) / temperature)`, which can be
            differentiated. None is the paper's step function.

    Returns:
        Votes, differentiable in both centroids: ``change`` always, ``pair`` and ``votes`` with a temperature, and then
        in threshold and temperature, too, where these are tensors.
    """
    KORNIA_CHECK_SHAPE(previous, ["*", "K", "3"])
    KORNIA_CHECK_SHAPE(current, ["*", str(previous.shape[-2]), "3"])
    KORNIA_CHECK_SHAPE(present, ["*", str(previous.shape[-2])])
    themselves = torch.eye(present.shape[-1], dtype=torch.bool)
    voters = present[..., :, None] & present[..., None, :] & ~themselves

    change = (_distances(current, present) - _distances(previous, present)).abs()
    change = torch.where(voters, change, 0)
    if temperature is None:
        indicator = (change >= distance_threshold).to(change.dtype)
    else:
        indicator = torch.sigmoid((change - distance_threshold) / temperature)
    pair = torch.where(voters, indicator, 0)
    votes = pair.sum(dim=-1)
    return Votes(votes, pair, change, dynamic=present & (votes >= vote_threshold))


def _distances(centroids: Tensor, present: Tensor) -> Tensor:
    """Distance between every two centroids, (..., K, K). Absent rows become the origin: NaN there would spread."""
    centroids = torch.where(present[..., None], centroids, 0)
    return torch.linalg.vector_norm(centroids[..., :, None, :] - centroids[..., None, :, :], dim=-1)


class HoughVoting(torch.nn.Module):
    """:func:`hough_vote` as a module. A setting given as a `torch.nn.Parameter` is learnt.

    Args:
        distance_threshold: change of a distance that counts as a vote, metres.
        vote_threshold: votes that make an object dynamic.
        temperature: softness of the vote, metres; None for the paper's step function.
    """

    def __init__(
        self,
        distance_threshold: float | Tensor,
        vote_threshold: float | Tensor,
        temperature: float | Tensor | None = None,
    ) -> None:
        super().__init__()
        self.distance_threshold = distance_threshold
        self.vote_threshold = vote_threshold
        self.temperature = temperature

    def forward(self, previous: Tensor, current: Tensor, present: Tensor) -> Votes:
        """Vote on centroids, metres, shape :math:`(..., K, 3)` with mask :math:`(..., K)`; see :func:`hough_vote`."""
        return hough_vote(previous, current, present, self.distance_threshold, self.vote_threshold, self.temperature)
