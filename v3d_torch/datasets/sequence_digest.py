"""Digest of a sequence, by which a later command recognises the sequence of a run."""

from __future__ import annotations

import json
from dataclasses import asdict
from hashlib import sha256

import torch

from v3d_torch.datasets.base import RGBDSequence

_UNITS = 1e6
"""Steps per second and metre to which values are rounded: the last digits of a ground truth that is converted to other
coordinates depend on the processor."""


def sequence_digest(sequence: RGBDSequence) -> str:
    """Return a digest of the camera, the timestamps and the ground truth of a sequence.

    It does not depend on the folder, so that a sequence can be moved. Images are not read, because a sequence can have
    100,000 of them on a network drive.

    Returns:
        SHA-256, 64 hexadecimal digits.
    """
    truth = sequence.groundtruth
    tables = [sequence.stamps] if truth is None else [sequence.stamps, truth.stamps, truth.T_wc]
    digest = sha256(json.dumps(asdict(sequence.camera), sort_keys=True).encode())
    for table in tables:
        digest.update(f"{tuple(table.shape)}".encode())
        digest.update((table * _UNITS).round().to(torch.int64).numpy().tobytes())
    return digest.hexdigest()
