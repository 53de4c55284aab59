"""Room of all scenes: walls, floor, ceiling, the pictures on the walls, and wooden furniture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo import materials, pictures
from v3d_torch.datasets.demo.materials import Colour
from v3d_torch.datasets.demo.scene import Box, Rectangle

ROOM_MIN, ROOM_MAX = (-2.35, -1.5, 0.0), (2.35, 4.2, 2.75)
"""Corners of the room with the smallest and largest coordinates, world frame, metres."""
OAK, WALNUT, PINE = (0.66, 0.46, 0.28), (0.42, 0.28, 0.19), (0.80, 0.64, 0.42)
"""Colours of wood, RGB in [0, 1]."""


def build_walls(rng: np.random.Generator) -> list[Rectangle]:
    """Build back wall, side walls, floor and ceiling; the front wall is never in view."""
    (x0, y0, z0), (x1, y1, z1) = ROOM_MIN, ROOM_MAX
    width, depth, height = x1 - x0, y1 - y0, z1 - z0
    wall = materials.plaster(rng, depth, height, 250, (0.80, 0.77, 0.68))
    brick = materials.bricks(rng, width, height, 330, (0.72, 0.45, 0.34))
    floor = materials.terrazzo(rng, width, depth, 200, (0.66, 0.62, 0.56))
    ceiling = materials.add_seams(materials.plaster(rng, width, depth, 150, (0.88, 0.88, 0.86)), 90)
    return [
        Rectangle((x0, y1, z1), (width, 0, 0), (0, 0, -height), brick),
        Rectangle((x0, y0, z1), (0, depth, 0), (0, 0, -height), wall),
        Rectangle((x1, y1, z1), (0, -depth, 0), (0, 0, -height), wall),
        Rectangle((x0, y1, z0), (width, 0, 0), (0, -depth, 0), floor),
        Rectangle((x0, y0, z1), (width, 0, 0), (0, depth, 0), ceiling),
    ]


def build_cupboard(
    rng: np.random.Generator, box: Box, colour: Colour, shelves: int = 0, density: int = 300
) -> list[Rectangle]:
    """Build a piece of wooden furniture.

    Args:
        rng: Random generator.
        box: Its shape.
        colour: Colour of the wood.
        shelves: Number of rows of books in front; 0 for a wooden front.
        density: Texels per metre of the top.
    """
    width, depth, height = np.subtract(box.high, box.low)
    top = materials.wood(rng, width, depth, density, colour, 0.12)
    side = materials.wood(rng, depth, height, 200, colour, 0.18)
    front = materials.wood(rng, width, height, 330, colour, 0.20)
    if shelves:
        front = pictures.bookshelf(rng, width, height, 330, shelves)
    return box.faces(front, top, side)


def build_wall_pictures(rng: np.random.Generator) -> list[Rectangle]:
    """Build the photographs and posters on the back wall and the side walls."""
    wood, black = (0.35, 0.24, 0.15), (0.06, 0.06, 0.07)
    cat = pictures.add_frame(pictures.load_photograph("cat.jpg"), 0.06, wood)
    hubble = pictures.add_frame(pictures.load_photograph("hubble.jpg"), 0.02, black)
    rocket = pictures.add_frame(pictures.load_photograph("rocket.jpg"), 0.04, black)

    def back(x: float, z: float, width: float, picture: NDArray[np.float32]) -> Rectangle:
        height = width * picture.shape[0] / picture.shape[1]
        return Rectangle((x, ROOM_MAX[1] - 0.02, z), (width, 0, 0), (0, 0, -height), picture)

    def side(sign: int, y: float, z: float, width: float, picture: NDArray[np.float32]) -> Rectangle:
        height = width * picture.shape[0] / picture.shape[1]
        start = y if sign < 0 else y + width
        return Rectangle((sign * (ROOM_MAX[0] - 0.02), start, z), (0, -sign * width, 0), (0, 0, -height), picture)

    return [
        back(-1.95, 2.56, 1.00, cat),
        back(0.78, 2.46, 1.05, rocket),
        back(-0.86, 1.62, 0.30, pictures.poster(rng, 0.30, 0.42, 600)),
        back(1.95, 2.2, 0.34, pictures.poster(rng, 0.34, 0.5, 600)),
        back(0.66, 1.66, 0.36, pictures.poster(rng, 0.36, 0.5, 600)),
        side(-1, 2.9, 2.2, 0.8, pictures.poster(rng, 0.8, 1.0, 400)),
        side(1, 2.8, 2.2, 0.9, hubble),
    ]


def lay_sheet(x: float, y: float, z: float, turn: float, width: float, picture: NDArray[np.float32]) -> Rectangle:
    """Lay a sheet of paper on a horizontal surface.

    Args:
        x: Position of its top left corner, metres.
        y: Position of its top left corner, metres.
        z: Height, metres.
        turn: Rotation about the vertical, radians.
        width: Width, metres.
        picture: What is printed on it.
    """
    across = width * np.asarray((np.cos(turn), np.sin(turn), 0.0))
    down = width * picture.shape[0] / picture.shape[1] * np.asarray((np.sin(turn), -np.cos(turn), 0.0))
    return Rectangle((x, y, z), tuple(across), tuple(down), picture)
