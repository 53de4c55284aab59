"""Recursive comparison of two objects, attribute by attribute."""

from __future__ import annotations

import types
from collections import deque
from collections.abc import Iterator
from functools import cached_property, partial
from typing import Any

import faiss
import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.odometry.rolling_shutter import Readout
from v3d_torch.runtime.stage_timer import StageTime

TIMED_STAGES = (
    *("segmentation", "depth", "features", "odometry", "free_space", "clouds", "objects", "tracking", "mapping"),
    *("bundle", "loop", "plausibility"),
)
"""Stages whose measured times are not compared."""


def differences(a: Any, b: Any, path: str, compared: dict[int, Any]) -> Iterator[str]:
    """Compare two objects recursively, attribute by attribute, except measured times.

    Args:
        a: First object.
        b: Second object.
        path: Path of the objects in the messages.
        compared: Pairs of objects compared so far by the identity of the first, empty at first: objects shared within
            ``a`` must be shared within ``b``.

    Yields:
        Path of each difference.
    """
    if type(a) is not type(b):
        yield f"{path}: {type(a)} and {type(b)}"
    elif isinstance(a, Config):  # differ in prefetching
        pass
    elif isinstance(a, Tensor):
        same_type = a.dtype == b.dtype and a.shape == b.shape
        if not same_type or not torch.equal(a.isnan(), b.isnan()) or not torch.equal(a.nan_to_num(), b.nan_to_num()):
            yield path
    elif isinstance(a, np.ndarray):
        if not np.array_equal(a, b):
            yield path
    elif isinstance(a, (dict, list, tuple, deque)):
        pairs = [(str(key), x) for key, x in (a.items() if isinstance(a, dict) else enumerate(a))]
        others = list(b.values()) if isinstance(a, dict) else list(b)
        if len(pairs) != len(others) or (isinstance(a, dict) and list(a) != list(b)):
            yield path
        else:
            for (name, x), y in zip(pairs, others, strict=True):
                is_time = isinstance(x, (float, StageTime)) and name in TIMED_STAGES
                if not is_time and name not in ("read", "seconds"):
                    yield from differences(x, y, f"{path}.{name}", compared)
    elif isinstance(a, faiss.IndexBinaryHash):
        if a.ntotal != b.ntotal:
            yield path
    elif isinstance(a, partial):
        yield from differences(a.keywords, b.keywords, path, compared)
    elif isinstance(a, (types.FunctionType, types.MethodType, types.BuiltinFunctionType, torch.Generator)):
        pass
    elif hasattr(a, "__dict__") and not isinstance(a, (str, type, BaseModel, PinholeCamera)):
        if id(a) in compared:
            if compared[id(a)][1] is not b:
                yield f"{path}: is another object"
            return
        compared[id(a)] = a, b
        cached = {name for name in dir(type(a)) if isinstance(getattr(type(a), name, None), cached_property)}
        # Measured times, and the threads of a pipeline with prefetching.
        skipped = cached | {"timer", "_stopwatch", "_thread", "_executor", "_get_result"}
        if not isinstance(a, Readout):  # its seconds are not the time of a stage
            skipped.add("seconds")
        first, second = ({key: value for key, value in vars(x).items() if key not in skipped} for x in (a, b))
        yield from differences(dict(sorted(first.items())), dict(sorted(second.items())), path, compared)
    elif not (a == b or (a != a and b != b)):
        yield f"{path}: {a} and {b}"
