"""Room of the demo: walls, furniture, pictures, objects on the counter, and people."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo import materials, pictures
from v3d_torch.datasets.demo.lighting import bake_lighting
from v3d_torch.datasets.demo.people import build_people, walk
from v3d_torch.datasets.demo.scene import Box, Figure, Rectangle, Scene

ROOM_MIN, ROOM_MAX = (-2.35, -1.5, 0.0), (2.35, 4.2, 2.75)
"""Corners of the room with the smallest and largest coordinates, world frame, metres."""
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


def build_room(seed: int) -> Scene:
    """Build the scene of the demo.

    Args:
        seed: Seed of all textures.

    Returns:
        The scene, with lighting baked into the textures of the room.
    """
    rng = np.random.default_rng(seed)
    furniture, boxes = _build_furniture(rng)
    figures = [
        *build_people(walker=(-1.75, 2.0, 0.64), stander=(-0.91, 3.05, 0.62), swayer=(1.02, 2.98, 0.70)),
        *_build_objects(rng),
    ]
    books_and_pages, book_boxes = _build_books_and_pages(rng)
    occluders = [*boxes, *book_boxes, *(f.shadow_box() for f in figures if f.motion is not walk)]
    surfaces = [*_build_walls(rng), *_build_wall_pictures(rng), *furniture, *books_and_pages]
    rectangles = bake_lighting(surfaces, occluders, ROOM_MIN, ROOM_MAX, seed)
    return Scene(rectangles, figures)


def _build_walls(rng: np.random.Generator) -> list[Rectangle]:
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


def _build_furniture(rng: np.random.Generator) -> tuple[list[Rectangle], list[Box]]:
    """Build counter, two low bookshelves, plant stand and bookshelf; return their faces and their boxes."""
    oak, walnut, pine = (0.66, 0.46, 0.28), (0.42, 0.28, 0.19), (0.80, 0.64, 0.42)
    counter = Box((-1.75, 0.45, 0.84), (1.75, 1.35, 0.90))
    low_left, low_right = Box((-1.24, 2.45, 0.0), (-0.34, 2.85, 0.80)), Box((0.45, 2.40, 0.0), (1.75, 2.75, 0.86))
    stand = Box((-1.80, 2.50, 0.0), (-1.24, 2.86, 1.12))
    shelf = Box((-0.50, 3.88, 0.0), (0.55, 4.20, 1.86))
    rectangles = []
    for box, colour in ((counter, oak), (low_left, walnut), (low_right, pine), (stand, oak), (shelf, walnut)):
        width, depth, height = np.subtract(box.high, box.low)
        top = materials.wood(rng, width, depth, 480 if box is counter else 300, colour, 0.12)
        side = materials.wood(rng, depth, height, 200, colour, 0.18)
        front = materials.wood(rng, width, height, 330, colour, 0.20)
        if box in (low_left, low_right, shelf):
            front = pictures.bookshelf(rng, width, height, 330, 5 if box is shelf else 2)
        rectangles += box.faces(front, top, side)
    return rectangles, [counter, low_left, low_right, stand, shelf]


def _build_wall_pictures(rng: np.random.Generator) -> list[Rectangle]:
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
        across = width * np.asarray((np.cos(turn), np.sin(turn), 0.0))
        down = width * picture.shape[0] / picture.shape[1] * np.asarray((np.sin(turn), -np.cos(turn), 0.0))
        rectangles.append(Rectangle((x, y, 0.9004 + 0.0002 * i), tuple(across), tuple(down), picture))
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
