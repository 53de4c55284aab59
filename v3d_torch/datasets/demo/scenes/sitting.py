"""Scene ``demo:sitting``: two people at a table, who gesture, lean and hand over a cup, and one who keeps still."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo import pictures
from v3d_torch.datasets.demo.camera_trajectory import CameraTrajectory
from v3d_torch.datasets.demo.lighting import bake_lighting
from v3d_torch.datasets.demo.motions import interpolate, make_pose, move
from v3d_torch.datasets.demo.people import Gestures, build_seated_person, recolour
from v3d_torch.datasets.demo.room import (
    OAK,
    PINE,
    ROOM_MAX,
    ROOM_MIN,
    WALNUT,
    build_cupboard,
    build_wall_pictures,
    build_walls,
    lay_sheet,
)
from v3d_torch.datasets.demo.scene import Body, Box, Figure, Rectangle, Scene

TRAJECTORY = CameraTrajectory((0.0, 0.1, 1.36), -6.0, start=11.0)
"""The camera is held by somebody who sits at the table, too."""
_TABLE = Box((-1.5, 0.62, 0.68), (1.5, 1.55, 0.74))
_PLACES = (-0.62, 0.66)
"""Places of the two people at the table: x, metres."""
_LAP = (1.80, 0.51)
"""Position of their laps: y and z, metres."""
_HANDOVER = (0.04, 1.36, 1.04)
"""Position of the cup when it is handed over, metres."""
_SHEETS = ((-0.85, 1.2, 0.2), (-0.35, 1.0, -0.3), (0.25, 0.95, 0.4), (0.65, 1.25, -0.15), (-0.05, 1.45, 0.1))
"""Pages on the table: x and y of the top left corner (metres), and rotation about the vertical (radians)."""


def build_sitting_scene(seed: int) -> Scene:
    """Build the scene.

    Args:
        seed: Seed of all textures.

    Returns:
        The scene: a person who gestures and hands over a cup (instance 1), a person who leans and takes it (2), a
        person who keeps still (3), and the cup (4).
    """
    rng = np.random.default_rng(seed + 1)
    furniture, boxes = _build_furniture(rng)
    sheets = [
        lay_sheet(x, y, _TABLE.high[2] + 0.0004 + 0.0002 * i, turn, 0.21, pictures.page(rng))
        for i, (x, y, turn) in enumerate(_SHEETS)
    ]
    sitting, still = _build_people()
    cup = Figure(pictures.load_photograph("cup.png"), (0.0, 0.0, -0.075), 0.15, 0.04)
    objects = [
        Figure(pictures.clock_face(), (-0.68, 4.17, 2.02), 0.36, 0.03),
        Figure(pictures.plant(rng), (-1.55, 2.75, 0.94), 0.62, 0.16),
        *(Figure(pictures.orange(rng), (x, y, 0.74), 0.085, 0.042) for x, y in ((0.92, 1.3), (1.02, 1.26))),
    ]
    occluders = [*boxes, *(figure.shadow_box() for figure in (still, *objects))]
    surfaces = [*build_walls(rng), *build_wall_pictures(rng), *furniture, *sheets]
    room = Body(bake_lighting(surfaces, occluders, ROOM_MIN, ROOM_MAX, seed), objects)
    bodies = [
        *sitting,
        Body(figures=[still], instance=3),
        Body(figures=[cup], motion=lambda t: make_pose(_hold_cup(t)), instance=4),
        room,
    ]
    return Scene(bodies, TRAJECTORY, {1: "person", 2: "person", 3: "person", 4: "cup"})


_hold_cup = interpolate([(1.7, (-0.13, 1.38, 0.81)), (2.4, _HANDOVER), (3.1, (0.36, 1.36, 0.81))])
"""Path of the middle of the cup: it stands, is handed over in the air, and is put down."""

_first_hand = interpolate(
    [
        (0.0, (-0.30, 1.45, 1.13)),
        (1.2, (-0.26, 1.43, 1.16)),
        (1.7, (-0.19, 1.43, 0.84)),
        (2.4, np.add(_HANDOVER, (-0.06, 0.05, 0.02))),
        (3.1, (-0.32, 1.45, 1.15)),
    ]
)
_second_hand = interpolate(
    [
        (1.7, (0.38, 1.50, 0.82)),
        (2.4, np.add(_HANDOVER, (0.06, 0.05, 0.0))),
        (3.1, (0.42, 1.42, 0.84)),
        (3.4, (0.42, 1.46, 0.82)),
    ]
)
_beat = interpolate([(0.0, (1.0,)), (1.2, (1.0,)), (1.7, (0.0,)), (2.4, (0.0,)), (3.1, (1.0,))])
"""Strength of the gestures of the first person, who does not gesture with the cup in the hand."""


def _gesture(t: float) -> NDArray[np.float64]:
    """Return the position of the hand of the first person."""
    beat = float(_beat(t)[0])
    wave = (0.09 * math.sin(2 * math.pi * 1.4 * t), 0.0, 0.07 * math.sin(2 * math.pi * 1.1 * t + 1.0))
    return np.asarray(_first_hand(t) + beat * np.asarray(wave))


def _talk(t: float) -> NDArray[np.float64]:
    """Return the angles of the head of the first person: it turns to the others and nods."""
    return np.array(
        (
            12.0 * math.sin(2 * math.pi * 0.5 * t) - 6.0,
            5.0 * math.sin(2 * math.pi * 1.3 * t),
            7.0 * math.sin(2 * math.pi * 0.8 * t + 0.5),
        )
    )


def _build_people() -> tuple[list[Body], Figure]:
    """Build the parts of the two people at the table, and the person who keeps still."""
    astronaut, photographer = (pictures.load_photograph(f"{name}.png") for name in ("astronaut", "photographer"))
    (first_x, second_x), (y, z) = _PLACES, _LAP
    sit = (first_x, y, z, 0.0, 0.0, 0.0)
    upright, leaning = (second_x, y, z, 0.0, 0.0, 0.0), (second_x, y, z, 0.0, 0.0, -9.0)
    first = Gestures(move([(0.0, sit)]), _talk, _gesture)
    second = Gestures(
        torso=move([(1.7, upright), (2.4, leaning), (3.2, upright)]),
        head=interpolate([(1.4, (0, 0, 0)), (1.8, (14, -4, -4)), (2.6, (14, -6, -4)), (3.2, (0, 0, 0))]),
        hand=_second_hand,
    )
    still = Figure(photographer, (0.10, 3.05, 0.62), 0.93, 0.18)
    parts = [
        *build_seated_person(astronaut, first, instance=1, mirrored=True),
        *build_seated_person(recolour(astronaut, 165.0, 0.5), second, instance=2, mirrored=False),
    ]
    return parts, still


def _build_furniture(rng: np.random.Generator) -> tuple[list[Rectangle], list[Box]]:
    """Build the table, a low and a high bookshelf and a plant stand; return their faces and their boxes."""
    low, high = Box((-0.55, 2.50, 0.0), (0.62, 2.90, 0.84)), Box((0.95, 3.88, 0.0), (1.95, 4.20, 1.70))
    stand = Box((-1.85, 2.55, 0.0), (-1.29, 2.95, 0.94))
    rectangles = [
        *build_cupboard(rng, _TABLE, PINE, density=480),
        *build_cupboard(rng, low, WALNUT, shelves=2),
        *build_cupboard(rng, high, OAK, shelves=5),
        *build_cupboard(rng, stand, WALNUT),
    ]
    return rectangles, [_TABLE, low, high, stand]
