"""How many threads a process works with: a frame is many small operations, and more threads wait for each other."""

from __future__ import annotations

import cv2
import torch


def share_out(threads: int) -> None:
    """Let torch and OpenCV work with so many threads; left to itself, OpenCV takes all cores for a tenth of the work.

    onnxruntime's are told when the network is opened (``segmentation.threads``); kornia-rs takes all cores for the
    pyramid's levels, or what RAYON_NUM_THREADS says, which it reads once.

    Args:
        threads: of each.
    """
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
