"""Check of the exposure of the colour images: where an image is white, there are no features."""

from __future__ import annotations

from v3d_torch.mapping.static_views import StaticViews

_WHITE = 250
"""Values of all channels from which a pixel is white; below 255, because JPEG changes values a little."""

_MAX_WHITE_FRACTION = 1 / 3
"""Largest fraction of white pixels in a well exposed image: windows and lamps cover up to a tenth of it, a white desk
near the camera up to a quarter."""

_MIN_VIEWS = 3
"""Minimum number of overexposed views, for a warning: a lamp or window can fill a single view."""


def check_exposure(views: StaticViews) -> list[str]:
    """Check whether images are overexposed.

    Args:
        views: Views of the keyframes; those of an earlier run are not checked.

    Returns:
        A list with one sentence that states when images are overexposed, or an empty list.
    """
    own = views.own
    fractions = [float((view.colour >= _WHITE).all(dim=0).float().mean()) for view in own]
    stamps = [view.keyframe.stamp for view, white in zip(own, fractions, strict=True) if white > _MAX_WHITE_FRACTION]
    if len(stamps) < _MIN_VIEWS:
        return []
    return [
        f"the images of {len(stamps)} of {len(own)} keyframes, from {stamps[0]:.3f} to {stamps[-1]:.3f} s, are"
        f" overexposed: up to {max(fractions):.0%} of their pixels are white and give no features, so that poses from"
        " then on can be wrong; lower the exposure of the camera"
    ]
