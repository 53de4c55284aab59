"""Threads and memory of this process."""

from __future__ import annotations

import ctypes
import sys

import cv2
import torch


def set_num_threads(threads: int) -> None:
    """Let torch and OpenCV work with so many threads; left to itself, OpenCV takes all cores for a tenth of the work.

    onnxruntime's are told when the network is opened (``segmentation.threads``); kornia-rs takes all cores for the
    pyramid's levels, or what RAYON_NUM_THREADS says, which it reads once.

    Args:
        threads: of each.
    """
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)


def trim_memory() -> None:
    """Let the C library return what lies free in between; it keeps pages, a quarter of what a long run seems to take.

    What each frame leaves behind is small and lives long, what it works with is large and does not: so the free parts
    lie between the kept ones, where glibc does not return them by itself. Other C libraries are left alone.
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
