r"""Online calibration of the rolling-shutter readout from the cost of local bundle adjustment.

A wrong readout distorts the images of a rotating camera. A map with the same distortion explains these images equally
well, until the camera rotates in another direction. Calibration therefore uses the cost after all poses and points
are adjusted again, as a function of the readout. Near the current readout this cost is a parabola: its minimum is an
estimate of the readout, and its curvature is the information of that estimate.
"""

from __future__ import annotations

from v3d_torch.geometry.camera import MAX_READOUT
from v3d_torch.odometry.rolling_shutter import Readout

_PRIOR_WEIGHT = 0.8
"""Weight of the earlier information. Successive local bundle adjustments share most of their observations, and the
first ones have the least accurate camera motion."""

_INFORMATION_WEIGHT = 0.1
"""Weight of the information from the curvature. Errors of depth and velocity are correlated between observations, so
that the curvature overestimates the information; 0.1 stands for standard deviations that are three times larger."""


def calibrate_readout(prior: Readout, slope: float, curvature: float) -> Readout:
    """Combine the current estimate of the readout with the minimum of the cost.

    Args:
        prior: Current estimate of the readout.
        slope: First derivative of the cost (twice the negative log-likelihood) with respect to the readout in
            seconds, at the current estimate.
        curvature: Second derivative of the cost with respect to the readout.

    Returns:
        The new estimate. It equals ``prior`` if that is certain, or if the cost has no minimum because the camera
        stood still or moved uniformly.
    """
    if prior.is_certain or curvature <= 0:
        return prior
    minimum = prior.seconds - slope / curvature
    prior_information = _PRIOR_WEIGHT * prior.information
    information = _INFORMATION_WEIGHT * curvature / 2
    total = prior_information + information
    seconds = (prior_information * prior.seconds + information * min(max(minimum, -MAX_READOUT), MAX_READOUT)) / total
    return Readout(seconds, total)
