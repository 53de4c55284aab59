"""Scene ``demo``: one person walks through a furnished room, one stands still, one sways."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo import pictures
from v3d_torch.datasets.demo.camera_trajectory import CameraTrajectory
from v3d_torch.datasets.demo.lighting import bake_lighting
from v3d_torch.datasets.demo.motions import make_pose
from v3d_torch.datasets.demo.people import recolour
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
from v3d_torch.datasets.demo.scene import Body, Box, Deformation, Figure, Rectangle, Scene

TRAJECTORY = CameraTrajectory((0.0, 0.0, 1.40), -5.5)
"""The camera is held at chest height behind the counter."""
WALK_SPEED = 1.0
"""Speed of the walking person, m/s: a slow walk."""
WALK_START = 0.60
"""Time at which the centre of the walking person is at the left end of its path, seconds."""
_PAGES = ((-0.22, 1.10, 0.30), (-0.12, 0.92, -0.15), (0.75, 1.02, 0.5), (-1.05, 1.22, -0.4), (0.15, 1.28, 0.1))
"""Pages on the counter: x and y of the top left corner (metres), and rotation about the vertical (radians)."""
_POSTCARDS = (
    (0.16, 1.0, 0.2),
    (0.34, 0.92, -0.5),
    (-0.4, 1.0, 0.6),
    (0.52, 1.3, -0.2),
    (-0.36, 1.3, 0.1),
    (0.6, 1.0, 1.2),
)
"""Postcards on the counter, described like the pages."""


def build_walking_scene(seed: int) -> Scene:
    """Build the scene.

    Args:
        seed: Seed of all textures.

    Returns:
        The scene, with lighting baked into the textures of the room: the walking person (instance 1), the swaying
        person (2), the standing person (3), and the room.
    """
    rng = np.random.default_rng(seed)
    furniture, boxes = _build_furniture(rng)
    people = _walker, swayer, stander = _build_people()
    objects = _build_objects(rng)
    books_and_pages, book_boxes = _build_books_and_pages(rng)
    still = [*stander.figures, *swayer.figures, *objects]
    occluders = [*boxes, *book_boxes, *(figure.shadow_box() for figure in still)]
    surfaces = [*build_walls(rng), *build_wall_pictures(rng), *furniture, *books_and_pages]
    rectangles = bake_lighting(surfaces, occluders, ROOM_MIN, ROOM_MAX, seed)
    labels = {person.instance: "person" for person in people}
    return Scene([*people, Body(rectangles, objects)], TRAJECTORY, labels)


def walk(t: float) -> NDArray[np.float64]:
    """Return the pose of the walking person: constant velocity along x, and a small rise with each of two steps/s."""
    return make_pose((WALK_SPEED * (t - WALK_START), 0.0, 0.015 * abs(math.sin(2 * math.pi * t))))


def sway(t: float) -> Deformation:
    """Return the deformation of the swaying person: lean and twist about the middle, which keep the centroid."""
    return Deformation(
        lean=0.26 * math.sin(2 * math.pi * 1.0 * t),
        twist=0.40 * math.sin(2 * math.pi * 0.9 * t + 0.8),
    )


def _build_people() -> tuple[Body, Body, Body]:
    """Build the walking person, the swaying person and the standing person."""
    astronaut, photographer = (pictures.load_photograph(f"{name}.png") for name in ("astronaut", "photographer"))
    walker = Figure(astronaut[:, ::-1], (-1.75, 2.0, 0.64), 1.06, 0.20)
    stander = Figure(photographer, (-0.91, 3.05, 0.62), 0.93, 0.18)
    swayer = Figure(
        recolour(astronaut, 165.0, 0.5),
        (1.02, 2.98, 0.70),
        1.00,
        0.20,
        yaw=-0.15,
        deformation=sway,
        pivot=(0.40, 0.57),
    )
    return (
        Body(figures=[walker], motion=walk, instance=1),
        Body(figures=[swayer], instance=2),
        Body(figures=[stander], instance=3),
    )


def _build_furniture(rng: np.random.Generator) -> tuple[list[Rectangle], list[Box]]:
    """Build counter, two low bookshelves, plant stand and bookshelf; return their faces and their boxes."""
    counter = Box((-1.75, 0.45, 0.84), (1.75, 1.35, 0.90))
    low_left, low_right = Box((-1.24, 2.45, 0.0), (-0.34, 2.85, 0.80)), Box((0.45, 2.40, 0.0), (1.75, 2.75, 0.86))
    stand = Box((-1.80, 2.50, 0.0), (-1.24, 2.86, 1.12))
    shelf = Box((-0.50, 3.88, 0.0), (0.55, 4.20, 1.86))
    rectangles = [
        *build_cupboard(rng, counter, OAK, density=480),
        *build_cupboard(rng, low_left, WALNUT, shelves=2),
        *build_cupboard(rng, low_right, PINE, shelves=2),
        *build_cupboard(rng, stand, OAK),
        *build_cupboard(rng, shelf, WALNUT, shelves=5),
    ]
    return rectangles, [counter, low_left, low_right, stand, shelf]


def _build_books_and_pages(rng: np.random.Generator) -> tuple[list[Rectangle], list[Box]]:
    """Build the books, pages and postcards on the counter; return their faces and the boxes of the books."""
    rectangles, boxes = [], []
    for i, (x, width) in enumerate(((-0.70, 0.25), (-0.69, 0.23), (-0.67, 0.20))):
        box = Box((x, 1.02 + 0.01 * i, 0.90 + 0.035 * i), (x + width, 1.20, 0.935 + 0.035 * i))
        pages = np.full((12, 80, 3), 0.86, np.float32)
        back = np.ascontiguousarray(pictures.book_spine(rng, 250, 36).swapaxes(0, 1))
        rectangles += box.faces(back, pictures.poster(rng, width, 0.18, 700), pages)
        boxes.append(box)
    sheets = [
        *((x, y, turn, 0.21, pictures.page(rng)) for x, y, turn in _PAGES),
        *((x, y, turn, 0.15, pictures.poster(rng, 0.15, 0.11, 1400)) for x, y, turn in _POSTCARDS),
    ]
    for i, (x, y, turn, width, picture) in enumerate(sheets):
        rectangles.append(lay_sheet(x, y, 0.9004 + 0.0002 * i, turn, width, picture))
    return rectangles, boxes


def _build_objects(rng: np.random.Generator) -> list[Figure]:
    """Build the clock, the plant, the cup and the oranges."""
    cup = pictures.load_photograph("cup.png")
    return [
        Figure(pictures.clock_face(), (-0.68, 4.17, 2.02), 0.36, 0.03),
        Figure(pictures.plant(rng), (-1.50, 2.70, 1.12), 0.62, 0.16),
        Figure(cup, (0.42, 1.12, 0.895), 0.15, 0.04),
        *(
            Figure(pictures.orange(rng), (x, y, 0.90), 0.085, 0.042)
            for x, y in ((0.80, 1.22), (0.90, 1.20), (0.86, 1.13))
        ),
    ]
