"""Options of RANSAC in OpenCV.

Raguram et al., USAC: A Universal Framework for Random Sample Consensus, PAMI 2013.
"""

from __future__ import annotations

import cv2

_CONFIDENCE = 0.999
"""Probability that the samples include one without outliers; it ends the sampling before the maximum number."""


def usac_options(threshold: float, iterations: int, seed: int) -> cv2.UsacParams:
    """Return options that give the same result on each call, without OpenCV's refinement.

    Args:
        threshold: Maximum error of an inlier, in the unit of the points.
        iterations: Maximum number of hypotheses.
        seed: Seed of the sampling.
    """
    options = cv2.UsacParams()
    options.threshold, options.maxIterations, options.confidence = threshold, iterations, _CONFIDENCE
    options.randomGeneratorState, options.isParallel = seed, False
    options.score = cv2.SCORE_METHOD_MSAC
    options.loMethod, options.final_polisher = cv2.LOCAL_OPTIM_NULL, cv2.NONE_POLISHER
    return options
