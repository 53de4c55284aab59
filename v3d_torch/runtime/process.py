"""Threads and memory of this process."""

from __future__ import annotations

import ctypes
import sys

import cv2
import torch

_TRIM_INTERVAL = 200
"""Number of frames between two calls of `trim_memory`, which takes some milliseconds."""


def set_num_threads(threads: int) -> None:
    """Set the number of threads of torch and OpenCV.

    The operations of a frame are small, so that more threads mostly wait for each other. The threads of onnxruntime are
    set by ``segmentation.threads``, those of kornia-rs by RAYON_NUM_THREADS, which it reads at its first call.

    Args:
        threads: Number of threads of each library.
    """
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def trim_memory() -> None:
    """Return unused memory of the C library to the system; does nothing if the library is not glibc.

    Each frame leaves small, long-lived blocks between large, short-lived ones, so glibc keeps many free pages.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def trim_memory_at_intervals(frames: int) -> None:
    """Call `trim_memory` after every 200th frame.

    Args:
        frames: Number of frames so far.
    """
    if frames % _TRIM_INTERVAL == 0:
        trim_memory()
