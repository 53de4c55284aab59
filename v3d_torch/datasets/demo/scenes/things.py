"""Scene ``demo:things``: a box is put down, a plant taken away, a chair pushed; a door, a ball and a balloon move."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo import materials, pictures
from v3d_torch.datasets.demo.camera_trajectory import CameraTrajectory
from v3d_torch.datasets.demo.lighting import bake_lighting
from v3d_torch.datasets.demo.materials import Texture
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
)
from v3d_torch.datasets.demo.scene import Body, Box, Figure, Rectangle, Scene

TRAJECTORY = CameraTrajectory((0.0, 0.0, 1.45), -9.0, start=23.0)
"""The camera is held by somebody who stands and looks at the floor as well."""
PUT_DOWN = 1.9
"""Time at which the box stands on the bench, seconds."""
TAKEN_AWAY = 1.6
"""Time at which the plant is lifted from the bench, seconds."""
_OUT = 3.2
"""Time at which the person with the plant is out of the room, seconds."""
_BENCH = Box((-1.9, 2.75, 0.0), (2.3, 3.15, 0.72))
_CABINET = Box((-1.80, 3.75, 1.20), (-1.05, 4.20, 1.95))
_DOOR_THICKNESS = 0.03
_CARTON = Box((-0.21, -0.15, 0.0), (0.21, 0.15, 0.30))
_BALL_RADIUS = 0.11
_BEHIND_BENCH = 3.36
"""Position y of the people, metres."""
_WAIST = 0.66
"""Height of the lower edge of the pictures of the people, metres."""


def build_things_scene(seed: int) -> Scene:
    """Build the scene.

    Args:
        seed: Seed of all textures.

    Returns:
        The scene: a person who puts down a box (instance 1), a person who takes away a plant (2), the box (3), a chair
        that is pushed (4), the door of a cabinet (5), a ball that rolls (6), a balloon (7), the plant (8), and a chair
        that stands still (9).
    """
    rng = np.random.default_rng(seed + 2)
    boxes = [_BENCH, _CABINET]
    chair = _build_chair(rng)
    plant = Figure(pictures.plant(rng), (0.0, 0.0, 0.0), 0.55, 0.14)
    ball = Figure(pictures.football(), (0.0, 0.0, -_BALL_RADIUS), 2 * _BALL_RADIUS, _BALL_RADIUS)
    balloon = Figure(pictures.balloon(), (0.0, 0.0, -0.22), 0.44, 0.12)
    clock = Figure(pictures.clock_face(), (-0.68, 4.17, 2.02), 0.36, 0.03)
    carton = materials.cardboard(rng, 0.42, 0.30, 500)
    door = _build_door(rng)
    surfaces = [
        *build_walls(rng),
        *build_wall_pictures(rng),
        *build_cupboard(rng, _BENCH, PINE, shelves=2),
        *_build_cabinet(rng),
    ]
    room = Body(bake_lighting(surfaces, boxes, ROOM_MIN, ROOM_MAX, seed), [clock])
    bodies = [
        *_build_people(),
        Body(_CARTON.closed_faces(carton, carton), motion=_carry_box, instance=3),
        Body(chair, motion=_push_chair, instance=4),
        Body(door, motion=_open_door, instance=5),
        Body(figures=[ball], motion=_roll_ball, instance=6),
        Body(figures=[balloon], motion=_float_balloon, instance=7),
        Body(figures=[plant], motion=_take_plant, instance=8),
        Body(chair, motion=lambda t: make_pose((-1.0, 2.25, 0.0), (-30.0, 0.0, 0.0)), instance=9),
        room,
    ]
    labels = {1: "person", 2: "person", 4: "chair", 6: "sports ball", 8: "potted plant", 9: "chair"}
    return Scene(bodies, TRAJECTORY, labels)


_carry_box = move(
    [
        (0.2, (-0.95, 2.96, 0.98, 0.0, 0.0, 0.0)),
        (1.4, (-0.15, 2.96, 0.98, 0.0, 0.0, 0.0)),
        (PUT_DOWN, (-0.15, 2.96, _BENCH.high[2], 0.0, 0.0, 0.0)),
    ]
)
_push_chair = move([(0.4, (0.55, 2.25, 0.0, 20.0, 0.0, 0.0)), (3.6, (1.00, 2.25, 0.0, 45.0, 0.0, 0.0))])
"""The chair is slower than 0.3 m/s."""
_open_door = move([(0.6, (*_CABINET.low[:2], 0.0, 0.0, 0.0, 0.0)), (1.9, (*_CABINET.low[:2], 0.0, -100.0, 0.0, 0.0))])
_take_plant = move(
    [
        (TAKEN_AWAY, (0.62, 2.93, _BENCH.high[2], 0.0, 0.0, 0.0)),
        (_OUT, (2.72, 2.93, _BENCH.high[2] + 0.2, 0.0, 0.0, 0.0)),
    ]
)
_ball_path = interpolate([(0.2, (1.75,)), (3.6, (-1.75,))])


def _roll_ball(t: float) -> NDArray[np.float64]:
    """Return the pose of the ball, which rolls over the floor without slipping."""
    x = float(_ball_path(t)[0])
    return make_pose((x, 2.62, _BALL_RADIUS), (0.0, 0.0, math.degrees(x / _BALL_RADIUS)))


def _float_balloon(t: float) -> NDArray[np.float64]:
    """Return the pose of the balloon, which rises slowly and swings."""
    x, y = 0.12 + 0.10 * math.sin(2 * math.pi * 0.35 * t), 2.0 + 0.05 * math.sin(2 * math.pi * 0.3 * t + 1.0)
    return make_pose((x, y, 1.25 + 0.16 * t), (0.0, 0.0, 6.0 * math.sin(2 * math.pi * 0.5 * t)))


def _build_people() -> list[Body]:
    """Build the parts of the person with the box and of the person who takes the plant."""
    astronaut = pictures.load_photograph("astronaut.png")

    def stand(x: float) -> tuple[float, ...]:
        return x, _BEHIND_BENCH, _WAIST, 0.0, 0.0, 0.0

    carrier = Gestures(
        torso=move([(0.2, stand(-1.05)), (1.4, stand(-0.25)), (2.3, stand(-0.25)), (3.5, stand(-1.10))]),
        head=interpolate([(0.2, (0, 0, 0)), (1.4, (10, -10, 5)), (2.3, (0, 0, 0))]),
        hand=interpolate(
            [
                (0.2, (-0.72, 2.92, 1.12)),
                (1.4, (0.08, 2.92, 1.12)),
                (PUT_DOWN, (0.08, 2.92, _BENCH.high[2] + 0.14)),
                (2.3, (0.12, 3.05, 1.0)),
                (3.5, (-0.75, 3.05, 0.8)),
            ]
        ),
    )
    taker = Gestures(
        torso=move([(0.5, stand(1.6)), (1.4, stand(1.0)), (TAKEN_AWAY, stand(1.0)), (_OUT, stand(3.1))]),
        head=interpolate([(0.5, (0, 0, 0)), (1.4, (12, -8, 0)), (_OUT, (0, 0, 0))]),
        hand=interpolate(
            [
                (0.5, (1.35, 3.0, 0.95)),
                (1.4, (0.66, 2.86, 0.86)),
                (TAKEN_AWAY, (0.66, 2.86, 0.86)),
                (_OUT, (2.76, 2.86, 1.06)),
            ]
        ),
    )
    return [
        *build_seated_person(astronaut, carrier, instance=1, mirrored=True),
        *build_seated_person(recolour(astronaut, 165.0, 0.5), taker, instance=2, mirrored=False),
    ]


def _build_chair(rng: np.random.Generator) -> list[Rectangle]:
    """Build a wooden chair that faces -y; its origin is on the floor below its middle."""
    half, leg = 0.21, 0.04
    boxes = [
        Box((-half, -half, 0.43), (half, half, 0.48)),
        Box((-half, half - 0.03, 0.58), (half, half, 0.92)),
        *(Box((x, -half, 0.0), (x + leg, -half + leg, 0.43)) for x in (-half, half - leg)),
        *(Box((x, half - leg, 0.0), (x + leg, half, 0.60)) for x in (-half, half - leg)),
    ]
    wood = materials.wood(rng, 0.42, 0.42, 300, OAK, 0.08)
    return [face for box in boxes for face in box.closed_faces(wood, wood)]


def _build_cabinet(rng: np.random.Generator) -> list[Rectangle]:
    """Build an open cabinet on the wall, with books in it."""
    (x0, y0, z0), (x1, y1, z1) = _CABINET.low, _CABINET.high
    width, depth, height = x1 - x0, y1 - y0, z1 - z0
    side = materials.wood(rng, depth, height, 200, WALNUT, 0.18)
    board = materials.wood(rng, width, depth, 200, WALNUT, 0.18)
    books = pictures.bookshelf(rng, width, height, 330, 2)
    _front, *outside = _CABINET.faces(books, board, side)
    inside = [
        Rectangle((x0, y0 + 0.25, z1), (width, 0, 0), (0, 0, -height), books),
        Rectangle((x0, y0, z1), (0, depth, 0), (0, 0, -height), side),
        Rectangle((x1, y1, z1), (0, -depth, 0), (0, 0, -height), side),
        Rectangle((x0, y1, z0), (width, 0, 0), (0, -depth, 0), board),
    ]
    return [*outside, *inside]


def _build_door(rng: np.random.Generator) -> list[Rectangle]:
    """Build the door of the cabinet; its origin is its hinge."""
    width, (z0, z1) = _CABINET.high[0] - _CABINET.low[0], (_CABINET.low[2], _CABINET.high[2])
    wood = materials.wood(rng, width, z1 - z0, 330, OAK, 0.15)
    panel = Box((0.0, -_DOOR_THICKNESS, z0), (width, 0.0, z1))
    knob = Box((width - 0.09, -_DOOR_THICKNESS - 0.03, z0 + 0.33), (width - 0.05, -_DOOR_THICKNESS, z0 + 0.41))
    metal: Texture = np.full((8, 8, 3), 0.75, np.float32)
    return [*panel.closed_faces(wood, wood), *knob.closed_faces(metal, metal)]
