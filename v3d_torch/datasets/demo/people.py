"""People in the scenes, made of two photographs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo.motions import Motion, Path, attach, bend, point_on, span
from v3d_torch.datasets.demo.scene import Body, Figure

_SEATED_HEIGHT = 0.95
"""Height of the picture of a seated astronaut, from the hair to the lap, metres."""
_NECK = (0.41, 0.33)
"""Joint of the head in the photograph of the astronaut: fractions of the width from the left and of the height."""
_SHOULDER = (0.15, 0.53)
"""Joint of the arm that is cut from the photograph."""
_COLLAR, _CHIN = 0.262, 0.345
"""Back and front of the collar, in which the neck is: fractions of the height of the photograph."""
_NECK_SIDES = (0.335, 0.475)
"""Left and right side of the neck: fractions of the width."""
_ARM_OUTLINE = ((0.0, 0.0), (0.09, 0.43), (0.15, 0.50), (0.19, 0.62), (0.21, 0.78), (0.24, 1.0), (0.0, 1.0))
"""Polygon around the arm of the astronaut that is cut away."""
_SLEEVE = np.s_[0.56:0.86, 0.03:0.17]
"""Part of the photograph that shows the sleeve: fractions of height and width."""
_UPPER_ARM, _FOREARM = 0.28, 0.33
"""Length of the upper arm, and of the forearm to the palm, metres."""
_ARM_WIDTH = 0.14
"""Width of a sleeve, metres."""
_TEXELS = 500
"""Texels of an arm per metre."""


def recolour(rgba: NDArray[np.float32], hue_shift: float, hair: float) -> NDArray[np.float32]:
    """Change the colours of suit and hair in the photograph of the astronaut, to get another person.

    Args:
        rgba: Cut-out of the astronaut, in [0, 1], float32, shape :math:`(H, W, 4)`.
        hue_shift: Change of the hue of the suit (its strongly saturated texels), degrees.
        hair: Factor on the brightness of the hair.

    Returns:
        Recoloured cut-out, same shape.
    """
    hsv = cv2.cvtColor(np.ascontiguousarray(rgba[..., :3]), cv2.COLOR_RGB2HSV)
    rows = np.linspace(0, 1, rgba.shape[0], dtype=np.float32)[:, None]
    suit = _feather((rows > 0.33) & (hsv[..., 1] > 0.45) & (hsv[..., 0] < 40))
    shifted = cv2.cvtColor(
        np.dstack([(hsv[..., 0] + hue_shift) % 360, hsv[..., 1] * 0.75, hsv[..., 2] * 0.85]), cv2.COLOR_HSV2RGB
    )
    rgb = suit * shifted + (1 - suit) * rgba[..., :3]
    brown = _feather((rows < 0.24) & (hsv[..., 1] > 0.34) & (hsv[..., 0] > 22) & (hsv[..., 0] < 60))
    rgb = rgb * (1 - brown * (1 - hair))
    return np.dstack([rgb, rgba[..., 3]]).astype(np.float32)


def _feather(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Blur a mask to soft edges, shape :math:`(H, W, 1)`."""
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.2)[..., None])


@dataclass(frozen=True)
class Gestures:
    """Motions of a seated person.

    Attributes:
        torso: Motion of the torso; its origin is the middle of the lap.
        head: Angles of the head relative to the torso, see `make_pose`, degrees.
        hand: Path of the palm of the moving arm, world frame.
    """

    torso: Motion
    head: Path
    hand: Path


def build_seated_person(
    astronaut: NDArray[np.float32], gestures: Gestures, instance: int, mirrored: bool
) -> list[Body]:
    """Build a seated person of rigid parts: torso, head, upper arm, and forearm with hand.

    Args:
        astronaut: Photograph of the astronaut, RGBA in [0, 1], shape :math:`(H, W, 4)`.
        gestures: Motions of the parts.
        instance: Instance id of all parts.
        mirrored: True for the moving arm on the right of the picture, False for the left.
    """
    side = -1.0 if mirrored else 1.0
    width = _SEATED_HEIGHT * astronaut.shape[1] / astronaut.shape[0]

    def place(point: tuple[float, float], forward: float) -> tuple[float, float, float]:
        """Return a point of the photograph in the frame of the torso, metres."""
        return side * (point[0] - 0.5) * width, -forward, (1.0 - point[1]) * _SEATED_HEIGHT

    def orient(rgba: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.ascontiguousarray(rgba[:, ::-1] if mirrored else rgba)

    torso, head, (left, right, bottom) = _cut_head(astronaut)
    head_foot = ((left + right) / 2 - _NECK[0]) * width * side, 0.0, (_NECK[1] - bottom) * _SEATED_HEIGHT
    head_figure = Figure(orient(head), head_foot, bottom * _SEATED_HEIGHT, 0.12)
    sleeve = _crop(astronaut[..., :3], _SLEEVE)
    upper_arm, forearm = _draw_upper_arm(sleeve), _draw_forearm(sleeve)
    cap = _ARM_WIDTH / 2
    shoulder = point_on(gestures.torso, place(_SHOULDER, 0.12))
    elbow = bend(shoulder, gestures.hand, (_UPPER_ARM, _FOREARM), (-0.6 * side, -0.3, -1.0))
    parts = [
        (Figure(orient(_cut_arm(torso)), (0.0, 0.0, 0.0), _SEATED_HEIGHT, 0.20), gestures.torso),
        (head_figure, attach(gestures.torso, place(_NECK, 0.12), gestures.head)),
        (_hang(orient(upper_arm), cap), span(shoulder, elbow)),
        (_hang(orient(forearm), cap), span(elbow, gestures.hand)),
    ]
    return [Body(figures=[figure], motion=motion, instance=instance) for figure, motion in parts]


def _hang(rgba: NDArray[np.float32], cap: float) -> Figure:
    """Return a limb that hangs from its origin, with its rounded upper end above it."""
    height = rgba.shape[0] / _TEXELS
    return Figure(rgba, (0.0, 0.0, cap - height), height, 0.05)


def _crop(image: NDArray[np.float32], part: tuple[slice, slice]) -> NDArray[np.float32]:
    """Return a part of an image that is given as fractions of its height and width."""
    rows, columns = (
        slice(round(axis.start * size), round(axis.stop * size))
        for axis, size in zip(part, image.shape[:2], strict=True)
    )
    return image[rows, columns]


def _cut_head(
    rgba: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], tuple[float, float, float]]:
    """Separate the head of the astronaut from the torso, whose collar is dark where the neck was.

    Returns:
        Torso; head in a smaller picture; left, right and lower edge of this picture as fractions of the photograph.
    """
    rows, columns = rgba.shape[:2]
    t, s = np.mgrid[0:rows, 0:columns] / np.array((rows, columns)).reshape(2, 1, 1)
    in_collar = (t >= _COLLAR) & (t < _CHIN) & (s > _NECK_SIDES[0]) & (s < _NECK_SIDES[1])
    torso, head = rgba.copy(), rgba.copy()
    torso[t < _COLLAR, 3] = 0.0
    torso[in_collar, :3] = 0.04
    head[~in_collar & (t >= _COLLAR), 3] = 0.0
    left, right, bottom = 0.24, 0.60, 0.36
    return torso, _crop(head, np.s_[0.0:bottom, left:right]), (left, right, bottom)


def _cut_arm(rgba: NDArray[np.float32]) -> NDArray[np.float32]:
    """Remove the arm on the left of the picture."""
    arm = np.zeros(rgba.shape[:2], np.uint8)
    corners = np.array(_ARM_OUTLINE) * (rgba.shape[1], rgba.shape[0])
    cv2.fillPoly(arm, [corners.round().astype(np.int32)], 1)
    return np.dstack([rgba[..., :3], np.where(arm > 0, np.float32(0.0), rgba[..., 3])])


def _draw_upper_arm(sleeve: NDArray[np.float32]) -> NDArray[np.float32]:
    """Draw a sleeve with rounded ends, RGBA."""
    rows, columns = round((_UPPER_ARM + _ARM_WIDTH) * _TEXELS), round(_ARM_WIDTH * _TEXELS)
    return _sleeve_picture(sleeve, rows, columns, rows)


def _draw_forearm(sleeve: NDArray[np.float32]) -> NDArray[np.float32]:
    """Draw a sleeve with a cuff and an open hand below, RGBA."""
    cuff, palm, tip = ((_ARM_WIDTH / 2 + length) * _TEXELS for length in (_FOREARM - 0.07, _FOREARM, _FOREARM + 0.10))
    rows, columns = round(tip), round(_ARM_WIDTH * _TEXELS)
    image = _sleeve_picture(sleeve, rows, columns, round(cuff))
    middle, unit = columns / 2, 0.01 * _TEXELS
    skin, shade = (0.87, 0.66, 0.55, 1.0), (0.70, 0.48, 0.39, 1.0)

    def draw_finger(start: tuple[float, float], end: tuple[float, float], width: float) -> None:
        for colour, thickness in ((shade, width + 0.5), (skin, width)):
            ends = [tuple(int(v) for v in point) for point in (start, end)]
            cv2.line(image, ends[0], ends[1], colour, max(1, round(thickness * unit)), cv2.LINE_AA)

    draw_finger((middle, cuff - unit), (middle, palm), 5.5)
    cv2.ellipse(image, (int(middle), int(palm)), (int(4.2 * unit), int(5.0 * unit)), 0, 0, 360, skin, -1, cv2.LINE_AA)
    for offset, length in ((-3.0, 7.6), (-1.0, 9.0), (1.0, 8.6), (3.0, 7.0)):
        draw_finger((middle + offset * unit, palm), (middle + 1.25 * offset * unit, palm + length * unit), 1.7)
    draw_finger((middle + 2.0 * unit, palm - 3.0 * unit), (middle + 6.0 * unit, palm + 2.0 * unit), 2.0)
    image[round(cuff - 2 * unit) : round(cuff), :, :3] *= 0.45
    return image


def _sleeve_picture(sleeve: NDArray[np.float32], rows: int, columns: int, end: int) -> NDArray[np.float32]:
    """Draw a sleeve from the upper edge to row ``end``: the photographed cloth, rounded above and below, RGBA."""
    cloth = cv2.resize(np.ascontiguousarray(sleeve), (columns, end), interpolation=cv2.INTER_AREA)
    x = np.linspace(-1.0, 1.0, columns, dtype=np.float32)
    image = np.zeros((rows, columns, 4), np.float32)
    image[:end, :, :3] = cloth * (1.0 - 0.4 * np.abs(x) ** 3)[None, :, None]
    solid = np.zeros((rows, columns), np.uint8)
    half = columns // 2
    cv2.line(solid, (half, half), (half, end - half), 255, columns - 2, cv2.LINE_AA)
    if end < rows:  # a cuff cuts the sleeve
        cv2.rectangle(solid, (half - round(0.62 * half), half), (half + round(0.62 * half), end), 255, -1)
    image[..., 3] = solid.astype(np.float32) / 255.0
    image[end:, :, 3] = 0.0
    return image
