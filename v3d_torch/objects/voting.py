"""Hough voting (paper, Sec. III-C, Alg. 1), and the rule of the system, which combines it with the free-space check."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from v3d_torch.config import VotingConfig
from v3d_torch.errors import ConfigError
from v3d_torch.geometry.argument_checks import check_masks, check_not_negative, check_shape
from v3d_torch.geometry.precision import result_dtype, working_dtype
from v3d_torch.geometry.settings_module import SettingsModule
from v3d_torch.runtime.batches import check_shapes

_STATIC_VOTER_RATIO = 0.5
"""Maximum motion of the centroid of a voting object if the free-space check is enabled, as a fraction of the distance
threshold: then at least half of every change that counts as a vote is motion of the other object."""


class Votes(NamedTuple):
    r"""Result of a vote among K objects.

    Attributes:
        votes: Number of votes for each object, :math:`V(O_i) = \sum_j I_{ij}`, dtype of the centroids, float32
            for integers, shape :math:`(..., K)`.
        pair: Indicator :math:`I_{ij}`, the vote of object j for object i, shape :math:`(..., K, K)`; symmetric, 0 on
            the diagonal and for objects that are not present.
        change: Absolute change of the distance between objects i and j, metres, shape :math:`(..., K, K)`; 0 on the
            diagonal and for objects that are not present.
        dynamic: Mask of the objects with enough votes, bool, shape :math:`(..., K)`.
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
    r"""Hough voting: each object votes for all objects whose distance to it has changed.

    The distance between two static objects does not depend on the camera position. Therefore the centroids of both
    times can stay in the camera frames of their own times, and no pose is needed. Row i of both inputs is the same
    object.

    Args:
        previous: Centroids at the earlier time, metres, shape :math:`(..., K, 3)`.
        current: Centroids at the current time, metres, dtype and shape of ``previous``.
        present: Mask of the objects that are observed at both times, bool, shape :math:`(..., K)`; the centroids of all
            others are ignored.
        distance_threshold: Minimum change of a distance that counts as a vote, :math:`T_d`, metres, a number or shape
            :math:`(...)`.
        vote_threshold: Minimum number of votes of a dynamic object, :math:`T_v`, a number or shape :math:`(...)`.
        temperature: Width of a soft vote, metres, a number or shape :math:`(...)`: the indicator is the differentiable
            function :math:`\sigma((change - T_d) / temperature)`. None for the step function of the paper.

    Returns:
        Votes. ``change`` is differentiable in both inputs of centroids. With a temperature, ``pair`` and ``votes`` are
        differentiable in centroids, and in ``distance_threshold`` and ``temperature`` if these are tensors.

    Raises:
        InputError: If ``present`` is not bool.
        ConfigError: If ``temperature`` is a number that is not positive, or a threshold is a number that is negative or
            NaN.
        ShapeError: If a threshold or ``temperature`` is a tensor of another shape.
    """
    _check_settings(distance_threshold, vote_threshold, temperature)
    check_masks(present=present)
    batch = check_shapes(previous=(previous, "K", 3), current=(current, "K", 3), present=(present, "K"))
    distance_threshold = _match_pairs("distance_threshold", distance_threshold, batch, 2)
    vote_threshold = _match_pairs("vote_threshold", vote_threshold, batch, 1)
    diagonal = torch.eye(present.shape[-1], dtype=torch.bool, device=present.device)
    comparable = present[..., :, None] & present[..., None, :] & ~diagonal

    dtype, wide = result_dtype(previous.dtype), working_dtype(previous.dtype)
    previous, current = previous.to(wide), current.to(wide)
    change = (_pairwise_distances(current, present) - _pairwise_distances(previous, present)).abs()
    change = torch.where(comparable, change, 0)
    if temperature is None:
        indicator = (change >= distance_threshold).to(change.dtype)
    else:
        indicator = torch.sigmoid((change - distance_threshold) / _match_pairs("temperature", temperature, batch, 2))
    pair = torch.where(comparable, indicator, 0)
    votes = pair.sum(dim=-1)
    return Votes(votes.to(dtype), pair.to(dtype), change.to(dtype), dynamic=present & (votes >= vote_threshold))


def _check_settings(
    distance_threshold: float | Tensor, vote_threshold: float | Tensor, temperature: float | Tensor | None
) -> None:
    check_not_negative(distance_threshold=distance_threshold, vote_threshold=vote_threshold)
    if isinstance(temperature, (int, float)) and not temperature > 0:  # also if it is NaN
        raise ConfigError(f"hough_vote: temperature is {temperature}; give a number above 0, or None")


def _match_pairs(name: str, value: float | Tensor, batch: torch.Size, dimensions: int) -> float | Tensor:
    """Return a parameter with extra dimensions if it is one number for each problem of the batch."""
    if not isinstance(value, Tensor) or value.numel() == 1:
        return value
    check_shape(name, value, *batch)
    return value.reshape(*batch, *(1,) * dimensions)


def _pairwise_distances(centroids: Tensor, present: Tensor) -> Tensor:
    """Return all pairwise distances, (..., K, K). Absent rows are set to the origin: NaN would reach the gradients."""
    centroids = torch.where(present[..., None], centroids, 0)
    return torch.linalg.vector_norm(centroids[..., :, None, :] - centroids[..., None, :, :], dim=-1)


def vote_with_free_space(
    previous: Tensor, current: Tensor, moved: Tensor | None, config: VotingConfig, present: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Hough voting (paper, Alg. 1) with the free-space check as an additional voter and veto.

    Objects that moved, or whose centroid jumped because they were cut off, do not vote. An object is dynamic only if it
    moved according to the free-space check, and has enough votes including the vote of the check.

    Args:
        previous: Centroids of K objects at the earlier time, world frame, metres, shape :math:`(..., K, 3)`.
        current: Centroids of the same objects at the current time, shape :math:`(..., K, 3)`.
        moved: Mask of the objects that moved according to the free-space check, bool, shape :math:`(..., K)`; None if
            the check is disabled, for the rule of the paper.
        config: Thresholds.
        present: Mask of the objects that are observed at both times, bool, shape :math:`(..., K)`; the others have no
            votes. None for all.

    Returns:
        Number of votes for each object, int64, shape :math:`(..., K)`; mask of the dynamic objects, bool, shape
        :math:`(..., K)`; and the votes between objects that counted, of column j for row i, int64, shape
        :math:`(..., K, K)`.
    """
    if present is None:
        present = torch.ones(previous.shape[:-1], dtype=torch.bool)
    result = hough_vote(previous, current, present, config.distance_threshold, config.vote_threshold)
    pair = result.pair.to(torch.int64)
    if moved is None:
        return pair.sum(dim=-1), result.dynamic, pair
    moved = moved & present
    is_static = (current - previous).norm(dim=-1) < _STATIC_VOTER_RATIO * config.distance_threshold
    may_vote = present & ~moved & is_static
    pair = pair * may_vote[..., None, :]
    votes = pair.sum(dim=-1) + moved
    # The voters on a moved object are the objects that may vote, and the free-space check. If there are fewer voters
    # than the vote threshold, all of them must vote for the object.
    voters = may_vote.sum(dim=-1, keepdim=True) + 1
    return votes, moved & (votes >= voters.clamp(max=config.vote_threshold)), pair


class HoughVoting(SettingsModule):
    """:func:`hough_vote` as a module. Distance threshold and temperature can be a `torch.nn.Parameter` that is learned.

    Args:
        distance_threshold: Minimum change of a distance that counts as a vote, metres.
        vote_threshold: Minimum number of votes of a dynamic object.
        temperature: Width of a soft vote, metres; None for the step function of the paper.

    Raises:
        ConfigError: If a number is not possible; see :func:`hough_vote`.
    """

    def __init__(
        self,
        distance_threshold: float | Tensor,
        vote_threshold: float | Tensor,
        temperature: float | Tensor | None = None,
    ) -> None:
        _check_settings(distance_threshold, vote_threshold, temperature)
        super().__init__()
        self.distance_threshold = distance_threshold
        self.vote_threshold = vote_threshold
        self.temperature = temperature

    def forward(self, previous: Tensor, current: Tensor, present: Tensor) -> Votes:
        """Vote on centroids, metres, shape :math:`(..., K, 3)`, with mask :math:`(..., K)`; see :func:`hough_vote`."""
        return hough_vote(previous, current, present, self.distance_threshold, self.vote_threshold, self.temperature)
