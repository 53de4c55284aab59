"""How long the camera takes to read an image, by what explains the map best.

Rows that are read late bend the image of a camera that turns; a map bent alike explains it as well, until the camera
turns another way. So a neighbourhood that was adjusted is asked what it would cost at another readout, all poses and
points adjusted anew: where the parabola of that cost has its bottom, and how steep it is, tell the readout and how sure
it is.
"""

from __future__ import annotations

from v3d_torch.geometry.camera import MAX_READOUT
from v3d_torch.odometry.rolling_shutter import Readout

_MEMORY = 0.8
"""Weight of what was known before: neighbourhoods of keyframes that follow each other share most observations, and the
first ones knew the camera's motion least."""

_TRUST = 0.1
"""Of the information that the steepness tells: depth and velocities err alike in many observations, and the first
readouts that TUM's and 7-Scenes' sequences tell are off by three times what independent errors would do."""


def calibrate_readout(known: Readout, slope: float, curvature: float) -> Readout:
    """The readout as it was known and the one that costs least, in one.

    Args:
        known: so far.
        slope: first derivative of the cost, twice the negative log-likelihood, by the seconds of the readout, there.
        curvature: second derivative.

    Returns:
        ``known`` where that is sure, and where no readout costs less than others: the camera stood still, or always
        moved alike.
    """
    if known.is_certain or curvature <= 0:
        return known
    bottom = known.seconds - slope / curvature
    before, told = _MEMORY * known.information, _TRUST * curvature / 2
    seconds = (before * known.seconds + told * min(max(bottom, -MAX_READOUT), MAX_READOUT)) / (before + told)
    return Readout(seconds, before + told)
