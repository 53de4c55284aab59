"""Vocabulary of ORB descriptors for ORB-SLAM3, in DBoW2's text format, trained on given sequences.

The tree of Galvez-Lopez and Tardos (Bags of Binary Words for Fast Place Recognition in Image Sequences, T-RO 2012): the
descriptors under a node are split by k-majority into up to ten children. All nodes of a level are split at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from v3d_torch.datasets import RGBDSequence
from v3d_torch.io.files import file_lock, write_text
from v3d_torch.io.paths import cache_dir

BRANCHES, DEPTH = 10, 6
"""Shape of the tree, as in ORB-SLAM3's own vocabulary.

ORB-SLAM3 compares features within nodes four levels above the leaves; with a lower tree it would compare all of them.
"""

Descriptors = NDArray[np.uint8]  # (N, 32)


@dataclass(frozen=True)
class Level:
    """Nodes of one level of the tree.

    Attributes:
        parent: Index of the parent among the nodes of the level above, int64, shape (M,).
        centre: Descriptors, uint8, shape (M, 32).
        leaf: True for words, bool, shape (M,).
        weight: Inverse document frequency of the words, 0 for other nodes, float64, shape (M,).
    """

    parent: NDArray[np.int64]
    centre: Descriptors
    leaf: NDArray[np.bool_]
    weight: NDArray[np.float64]


def vocabulary(sequences: Iterable[RGBDSequence], images: int = 200, features: int = 1000) -> Path:
    """Return the file of a vocabulary trained on sequences; train it if it is not in the cache.

    Args:
        sequences: Sequences whose images to use, evenly spread over all of them.
        images: Approximate number of images.
        features: Number of ORB features per image.

    Raises:
        InputError: If an image cannot be read.
        OutputError: If the cache is not writable.
    """
    sequences = list(sequences)
    contents = [(s.name, len(s), float(s.stamps[0])) for s in sequences]
    key = sha256(repr((contents, images, features, BRANCHES, DEPTH)).encode()).hexdigest()[:12]
    path = cache_dir() / f"orb_vocabulary_{key}.txt"
    with file_lock(path):
        if not path.is_file():
            write_text(path, text(train(*collect(sequences, images, features))))
    return path


def collect(sequences: list[RGBDSequence], images: int, features: int) -> tuple[Descriptors, NDArray[np.int64]]:
    """Return descriptors, shape (N, 32), and the index of the image of each, shape (N,)."""
    orb = cv2.ORB_create(features)
    step = -(-sum(map(len, sequences)) // images)
    found = []
    for sequence in sequences:
        for index in range(0, len(sequence), step):
            grey = cv2.cvtColor(sequence[index].image.permute(1, 2, 0).numpy(), cv2.COLOR_RGB2GRAY)
            descriptors = orb.detectAndCompute(grey, None)[1]
            if descriptors is not None:
                found.append(descriptors)
    return np.concatenate(found), np.repeat(np.arange(len(found)), [len(d) for d in found])


def train(descriptors: Descriptors, image: NDArray[np.int64], smallest: int = 20, seed: int = 0) -> list[Level]:
    """Grow the tree from the root down.

    Args:
        descriptors: Descriptors, uint8, shape (N, 32).
        image: Index of the image of each descriptor, shape (N,).
        smallest: Nodes with fewer descriptors are not split.
        seed: Seed of the initial centres.

    Returns:
        Levels of the tree, without the root.
    """
    order = np.random.default_rng(seed).permutation(len(descriptors))
    descriptors, image = descriptors[order], image[order]
    images = len(np.unique(image))
    levels: list[Level] = []
    node = np.zeros(len(descriptors), dtype=np.int64)  # node of each descriptor among those of its level
    for depth in range(1, DEPTH + 1):
        split, family = np.unique(node, return_inverse=True)
        cluster, centre = k_majority(descriptors, family)
        used, node = np.unique(cluster, return_inverse=True)  # empty clusters are not nodes
        leaf = (np.bincount(node) < smallest) | (depth == DEPTH)
        shown = np.bincount(np.unique(np.stack([node, image]), axis=1)[0])  # number of images that show each node
        levels.append(Level(split[used // BRANCHES], centre[used], leaf, np.where(leaf, np.log(images / shown), 0.0)))
        left = ~leaf[node]
        descriptors, image, node = descriptors[left], image[left], node[left]
        if not len(node):
            break
    return levels


def k_majority(
    descriptors: Descriptors, family: NDArray[np.int64], rounds: int = 6
) -> tuple[NDArray[np.int64], Descriptors]:
    """Split each of several families of descriptors by Hamming distance (Grana et al., VISAPP 2013).

    Args:
        descriptors: Descriptors in random order, uint8, shape (N, 32).
        family: Family of each descriptor, counted from 0, none empty, shape (N,).
        rounds: Largest number of assignments.

    Returns:
        Cluster of each descriptor, ``BRANCHES * family`` and up, shape (N,), and the centres of all clusters.
    """
    sizes = np.bincount(family)
    member = np.minimum(np.arange(BRANCHES), sizes[:, None] - 1)  # of two equal centres, the second one gets no members
    start = np.cumsum(sizes) - sizes
    centre = descriptors[np.argsort(family, kind="stable")[start[:, None] + member]].reshape(-1, 32)
    cluster = np.full(len(family), -1)
    for _ in range(rounds):
        before, cluster = cluster, nearest(descriptors, centre, family)
        if (before == cluster).all():
            break
        centre = majority(descriptors, cluster, centre)
    return cluster, centre


def nearest(descriptors: Descriptors, centre: Descriptors, family: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the cluster in the family of each descriptor whose centre differs in the fewest bits."""
    words, centres = descriptors.view(np.uint64), centre.view(np.uint64).reshape(-1, BRANCHES, 4)
    found = [
        np.bitwise_count(words[part, None] ^ centres[family[part]]).sum(axis=-1, dtype=np.int64).argmin(axis=1)
        for part in parts(len(words))
    ]
    return BRANCHES * family + np.concatenate(found)


def majority(descriptors: Descriptors, cluster: NDArray[np.int64], centre: Descriptors) -> Descriptors:
    """Return centres with the most frequent value of each bit; centres without members stay."""
    ones = torch.zeros(len(centre), 256, dtype=torch.int32)
    for part in parts(len(descriptors)):
        bits = torch.from_numpy(np.unpackbits(descriptors[part], axis=1).astype(np.int32))
        ones.index_add_(0, torch.from_numpy(cluster[part]), bits)
    members = np.bincount(cluster, minlength=len(centre))[:, None]
    return np.where(members > 0, np.packbits(2 * ones.numpy() >= members, axis=1), centre)


def parts(count: int, size: int = 1 << 15) -> Iterator[slice]:
    """Return slices of ``count`` descriptors that bound the memory of a computation."""
    return (slice(start, start + size) for start in range(0, count, size))


def text(levels: list[Level]) -> str:
    """Return the tree in the format of DBoW2's ``loadFromTextFile``.

    The first line has branches, depth, scoring (0 = L1) and weighting (0 = TF-IDF). Each further line is a node; nodes
    are numbered by line. It has the number of its parent (0 = the root), whether it is a word, the bytes of its
    descriptor and its weight. The file ends without a line break, which the reader would parse as another node.
    """
    lines = [f"{BRANCHES} {DEPTH} 0 0"]
    above, below = 0, 1  # number of the first node of the level above and of this level
    for level in levels:
        lines += [
            f"{above + parent} {int(leaf)} {' '.join(map(str, centre))} {weight:.6g}"
            for parent, leaf, centre, weight in zip(
                level.parent, level.leaf, level.centre.tolist(), level.weight, strict=True
            )
        ]
        above, below = below, below + len(level.parent)
    return "\n".join(lines)
