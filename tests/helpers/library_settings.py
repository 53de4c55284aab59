"""Settings of libraries that are changed within a context."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

import faiss
import torch

_T = TypeVar("_T")


@contextmanager
def _changed(get: Callable[[], _T], set_to: Callable[[_T], object], value: _T) -> Iterator[None]:
    """Change a setting within the context, and restore it afterwards."""
    before = get()
    set_to(value)
    try:
        yield
    finally:
        set_to(before)


default_dtype = partial(_changed, torch.get_default_dtype, torch.set_default_dtype)
"""Another default dtype of torch, as research code sets it."""

torch_threads = partial(_changed, torch.get_num_threads, torch.set_num_threads)
"""Another number of threads of torch."""

faiss_threads = partial(_changed, faiss.omp_get_max_threads, faiss.omp_set_num_threads)
"""Another number of threads of faiss."""
