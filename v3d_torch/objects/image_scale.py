"""Distances in pixels of the object stage, for images of any size.

The configuration states them for the images of a Kinect, 640 columns and a focal length of 525 pixels. The network
enlarges its masks to the size of the image, and its errors with them. Points of one surface are farther apart if the
focal length is shorter.
"""

from __future__ import annotations

from v3d_torch.config import ObjectsConfig
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.pixel_scale import pixel_scale

_FOCAL_LENGTH = 525.0

_COARSE_STRIDE = 4
"""Stride of coarse images, pixels of a Kinect. Pixels are 2 cm apart at 2.5 m, as dense as the clouds, and masks have
160 columns, more than the network's own masks, which have 104 by default."""


def coarse_stride(camera: PinholeCamera) -> int:
    """Stride of the pixels of coarse images, in which views and masks are compared: 4 for a Kinect.

    Args:
        camera: Camera of the images.
    """
    return _scale(_COARSE_STRIDE, pixel_scale(camera.width))


def scale_to_image(config: ObjectsConfig, camera: PinholeCamera) -> ObjectsConfig:
    """Scale margins of masks and stride of clouds to the number of columns, and the stride to a shorter focal length.

    A value that is not 0 stays at least one pixel.

    Args:
        config: Configuration for the images of a Kinect.
        camera: Camera of the images.
    """
    scale, margins = pixel_scale(camera.width), config.static_mask
    names = ("dilation", "map_dilation", "depth_margin", "surface_margin")
    scaled = {name: _scale(getattr(margins, name), scale) for name in names}
    stride = _scale(config.clouds.stride, min(scale, camera.fx / _FOCAL_LENGTH))
    return config.model_copy(
        update={
            "clouds": config.clouds.model_copy(update={"stride": stride}),
            "static_mask": margins.model_copy(update=scaled),
        }
    )


def _scale(pixels: int, factor: float) -> int:
    return max(round(pixels * factor), 1) if pixels else 0
