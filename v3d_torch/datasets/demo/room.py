"""The room: walls, furniture, pictures, things on the counter, people."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo import materials, pictures
from v3d_torch.datasets.demo.geometry import Box, Figure, Rectangle, Scene
from v3d_torch.datasets.demo.lighting import bake
from v3d_torch.datasets.demo.people import people, walk

LOW, HIGH = (-2.35, -1.5, 0.0), (2.35, 4.2, 2.75)
"""Corners of the room, metres."""
PAPERS = ((-0.22, 1.10, 0.30), (-0.12, 0.92, -0.15), (0.75, 1.02, 0.5), (-1.05, 1.22, -0.4), (0.15, 1.28, 0.1))
"""Pages on the counter: x, y of the top left corner, metres, and turn about the vertical, radians."""
POSTCARDS = (
    (0.16, 1.0, 0.2),
    (0.34, 0.92, -0.5),
    (-0.4, 1.0, 0.6),
    (0.52, 1.3, -0.2),
    (-0.36, 1.3, 0.1),
    (0.6, 1.0, 1.2),
)
"""As the pages."""


def build_room(seed: int) -> Scene:
    """Make the demo's room.

    Args:
        seed: of every texture.

    Returns:
        The scene, light baked in.
    """
    rng = np.random.default_rng(seed)
    furniture, boxes = _furniture(rng)
    figures = [
        *people(walker=(-1.75, 2.0, 0.64), stander=(-0.91, 3.05, 0.62), swayer=(1.02, 2.98, 0.70)),
        *_things(rng),
    ]
    books, stacked = _books_and_papers(rng)
    shadows = [*boxes, *stacked, *(f.shadow() for f in figures if f.motion is not walk)]
    rectangles = bake([*_shell(rng), *_on_walls(rng), *furniture, *books], shadows, LOW, HIGH, seed)
    return Scene(rectangles, figures)


def _shell(rng: np.random.Generator) -> list[Rectangle]:
    (x0, y0, z0), (x1, y1, z1) = LOW, HIGH
    width, depth, height = x1 - x0, y1 - y0, z1 - z0
    wall = materials.plaster(rng, depth, height, 250, (0.80, 0.77, 0.68))
    brick = materials.bricks(rng, width, height, 330, (0.72, 0.45, 0.34))
    floor = materials.terrazzo(rng, width, depth, 200, (0.66, 0.62, 0.56))
    ceiling = materials.with_seams(materials.plaster(rng, width, depth, 150, (0.88, 0.88, 0.86)), 90)
    return [
        Rectangle((x0, y1, z1), (width, 0, 0), (0, 0, -height), brick),
        Rectangle((x0, y0, z1), (0, depth, 0), (0, 0, -height), wall),
        Rectangle((x1, y1, z1), (0, -depth, 0), (0, 0, -height), wall),
        Rectangle((x0, y1, z0), (width, 0, 0), (0, -depth, 0), floor),
        Rectangle((x0, y0, z1), (width, 0, 0), (0, depth, 0), ceiling),
    ]


def _furniture(rng: np.random.Generator) -> tuple[list[Rectangle], list[Box]]:
    oak, walnut, pine = (0.66, 0.46, 0.28), (0.42, 0.28, 0.19), (0.80, 0.64, 0.42)
    counter = Box((-1.75, 0.45, 0.84), (1.75, 1.35, 0.90))
    left, right = Box((-1.24, 2.45, 0.0), (-0.34, 2.85, 0.80)), Box((0.45, 2.40, 0.0), (1.75, 2.75, 0.86))
    stand = Box((-1.80, 2.50, 0.0), (-1.24, 2.86, 1.12))
    shelf = Box((-0.50, 3.88, 0.0), (0.55, 4.20, 1.86))
    rectangles = []
    for box, colour in ((counter, oak), (left, walnut), (right, pine), (stand, oak), (shelf, walnut)):
        width, depth, height = np.subtract(box.high, box.low)
        top = materials.wood(rng, width, depth, 480 if box is counter else 300, colour, 0.12)
        side = materials.wood(rng, depth, height, 200, colour, 0.18)
        front = materials.wood(rng, width, height, 330, colour, 0.20)
        if box in (left, right, shelf):
            front = pictures.bookshelf(rng, width, height, 330, 5 if box is shelf else 2)
        rectangles += box.faces(front, top, side)
    return rectangles, [counter, left, right, stand, shelf]


def _on_walls(rng: np.random.Generator) -> list[Rectangle]:
    wood, black = (0.35, 0.24, 0.15), (0.06, 0.06, 0.07)
    cat = pictures.framed(pictures.photograph("cat.jpg"), 0.06, wood)
    hubble = pictures.framed(pictures.photograph("hubble.jpg"), 0.02, black)
    rocket = pictures.framed(pictures.photograph("rocket.jpg"), 0.04, black)

    def back(x: float, z: float, width: float, picture: NDArray[np.float32]) -> Rectangle:
        height = width * picture.shape[0] / picture.shape[1]
        return Rectangle((x, HIGH[1] - 0.02, z), (width, 0, 0), (0, 0, -height), picture)

    def side(sign: int, y: float, z: float, width: float, picture: NDArray[np.float32]) -> Rectangle:
        height = width * picture.shape[0] / picture.shape[1]
        start = y if sign < 0 else y + width
        return Rectangle((sign * (HIGH[0] - 0.02), start, z), (0, -sign * width, 0), (0, 0, -height), picture)

    return [
        back(-1.95, 2.56, 1.00, cat),
        back(0.78, 2.46, 1.05, rocket),
        back(-0.86, 1.62, 0.30, pictures.poster(rng, 0.30, 0.42, 600)),
        back(1.95, 2.2, 0.34, pictures.poster(rng, 0.34, 0.5, 600)),
        back(0.66, 1.66, 0.36, pictures.poster(rng, 0.36, 0.5, 600)),
        side(-1, 2.9, 2.2, 0.8, pictures.poster(rng, 0.8, 1.0, 400)),
        side(1, 2.8, 2.2, 0.9, hubble),
    ]


def _books_and_papers(rng: np.random.Generator) -> tuple[list[Rectangle], list[Box]]:
    """On the counter."""
    rectangles, boxes = [], []
    for i, (x, width) in enumerate(((-0.70, 0.25), (-0.69, 0.23), (-0.67, 0.20))):
        box = Box((x, 1.02 + 0.01 * i, 0.90 + 0.035 * i), (x + width, 1.20, 0.935 + 0.035 * i))
        pages = np.full((12, 80, 3), 0.86, np.float32)
        back = np.ascontiguousarray(pictures.book_spine(rng, 250, 36).swapaxes(0, 1))
        rectangles += box.faces(back, pictures.poster(rng, width, 0.18, 700), pages)
        boxes.append(box)
    sheets = [
        *((x, y, turn, 0.21, pictures.paper(rng)) for x, y, turn in PAPERS),
        *((x, y, turn, 0.15, pictures.poster(rng, 0.15, 0.11, 1400)) for x, y, turn in POSTCARDS),
    ]
    for i, (x, y, turn, width, picture) in enumerate(sheets):
        across = width * np.asarray((np.cos(turn), np.sin(turn), 0.0))
        down = width * picture.shape[0] / picture.shape[1] * np.asarray((np.sin(turn), -np.cos(turn), 0.0))
        rectangles.append(Rectangle((x, y, 0.9004 + 0.0002 * i), tuple(across), tuple(down), picture))
    return rectangles, boxes


def _things(rng: np.random.Generator) -> list[Figure]:
    cup = pictures.photograph("cup.png")
    return [
        Figure(pictures.clock_face(), (-0.68, 4.17, 2.02), 0.36, 0.03),
        Figure(pictures.plant(rng), (-1.50, 2.70, 1.12), 0.62, 0.16),
        Figure(cup, (0.42, 1.12, 0.895), 0.15, 0.04),
        *(
            Figure(pictures.orange(rng), (x, y, 0.90), 0.085, 0.042)
            for x, y in ((0.80, 1.22), (0.90, 1.20), (0.86, 1.13))
        ),
    ]
