"""Pictures for surfaces and figures: photographs, and drawings of books, posters, pages, a clock, a plant, an orange.

All pictures are RGB in [0, 1], float32, shape :math:`(H, W, 3)`; those of figures are RGBA, with a silhouette.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from v3d_torch.datasets.demo.materials import Colour, Texture, fractal_noise, texels, tint
from v3d_torch.errors import InputError
from v3d_torch.io.image_file import read_image

_ASSETS = Path(__file__).parents[1] / "assets"
_COVER_COLOURS = np.asarray(
    [
        (0.58, 0.14, 0.12), (0.75, 0.36, 0.16), (0.83, 0.66, 0.30), (0.87, 0.82, 0.70), (0.34, 0.42, 0.22),
        (0.14, 0.32, 0.30), (0.20, 0.33, 0.50), (0.13, 0.17, 0.30), (0.42, 0.22, 0.34), (0.30, 0.21, 0.15),
        (0.62, 0.60, 0.56), (0.16, 0.16, 0.17),
    ],
    np.float32,
)  # fmt: skip
"""Colours of book covers, RGB in [0, 1]."""


def load_photograph(name: str) -> NDArray[np.float32]:
    """Load a photograph from the assets folder of the package.

    Raises:
        InputError: If the file is missing or damaged.
    """
    image = read_image(_ASSETS / name, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{_ASSETS / name}: photograph of the demo cannot be read; install the package again")
    order = cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(image, order).astype(np.float32) / np.float32(255.0)


def add_frame(image: Texture, border: float, colour: Colour) -> Texture:
    """Add a picture frame, whose width is a fraction ``border`` of the image height."""
    n = max(2, round(border * image.shape[0]))
    return np.asarray(cv2.copyMakeBorder(image, n, n, n, n, cv2.BORDER_CONSTANT, value=colour), np.float32)


def bookshelf(rng: np.random.Generator, width: float, height: float, density: float, boards: int) -> Texture:
    """Bookshelf with ``boards`` rows of books of different size, colour, bands and lettering."""
    rows, columns = texels(height, density), texels(width, density)
    image = np.full((rows, columns, 3), (0.10, 0.075, 0.05), np.float32)
    edge = max(3, round(0.022 * density))
    pitch = (rows - edge) // boards
    for board in range(boards):
        floor = edge + (board + 1) * pitch - edge
        left = edge + 1
        while left < columns - edge - 3:
            thick = int(rng.integers(round(0.018 * density), round(0.05 * density)))
            thick = min(thick, columns - edge - 1 - left)
            tall = int(pitch * rng.uniform(0.55, 0.84))
            image[floor - tall : floor, left : left + thick] = book_spine(rng, tall, thick)
            left += thick + int(rng.random() < 0.12) * round(0.03 * density)
    shelf = tint((0.52, 0.36, 0.22), 1.0 + 0.25 * fractal_noise(rng, rows, columns, (rows / 9, 5), 4))
    lines = np.zeros((rows, columns), bool)
    lines[:, :edge] = lines[:, -edge:] = True
    for board in range(boards + 1):
        lines[board * pitch : board * pitch + edge] = True
    image[lines] = shelf[lines]
    return image


def book_spine(rng: np.random.Generator, rows: int, columns: int) -> Texture:
    """Spine of a book: one colour, shaded as a rounded back, with bands and lettering."""
    colour = _COVER_COLOURS[rng.integers(len(_COVER_COLOURS))] * rng.uniform(0.7, 1.15)
    round_back = 1.0 - 0.45 * np.abs(np.linspace(-1, 1, columns, dtype=np.float32)) ** 3
    book = np.broadcast_to(colour * round_back[None, :, None], (rows, columns, 3)).astype(np.float32)
    ink = colour * 0.35 if colour.mean() > 0.45 else np.minimum(colour * 0.4 + 0.6, 1.0)
    for place in rng.uniform(0.06, 0.94, int(rng.integers(1, 4))):
        top = int(place * rows)
        book[top : top + int(rng.integers(1, 5))] = ink
    first, last = sorted(rng.uniform(0.15, 0.85, 2))
    inset = max(1, columns // 4)
    for row in range(int(first * rows), int(last * rows), 3):
        if rng.random() < 0.8:
            book[row : row + 2, inset : columns - inset] = ink
    return np.clip(book, 0.0, 1.0).astype(np.float32)


def poster(rng: np.random.Generator, width: float, height: float, density: float) -> Texture:
    """Abstract poster: overlapping discs, bars and triangles in a few colours, and a line of lettering."""
    rows, columns = texels(height, density), texels(width, density)
    paper = np.asarray((0.93, 0.90, 0.83), np.float32)
    image = np.full((rows, columns, 3), paper, np.float32)
    palette = np.asarray(
        [(0.83, 0.30, 0.20), (0.95, 0.70, 0.25), (0.13, 0.35, 0.48), (0.20, 0.55, 0.50), (0.12, 0.12, 0.16)]
    )
    size = min(rows, columns)
    for _ in range(26):
        colour = tuple(palette[rng.integers(len(palette))])
        centre = rng.uniform((0, 0), (columns, rows * 0.86))
        radius = size * rng.uniform(0.04, 0.17)
        turn = rng.uniform(0, 2 * np.pi)
        corners = int(rng.choice([3, 4, 24]))
        angles = turn + np.arange(corners) * 2 * np.pi / corners
        stretch = np.asarray((1.0, rng.uniform(0.35, 1.0)))
        points = centre + radius * stretch * np.stack([np.cos(angles), np.sin(angles)], 1)
        cv2.fillPoly(image, [points.astype(np.int32)], colour, cv2.LINE_AA)
    image[int(rows * 0.88) :] = paper
    for left in np.arange(columns * 0.08, columns * 0.9, columns * 0.035):
        glyph = np.s_[int(rows * 0.91) : int(rows * 0.955), int(left) : int(left + columns * rng.uniform(0.012, 0.026))]
        image[glyph] = palette[-1]
    return image


def page(rng: np.random.Generator, rows: int = 300, columns: int = 210) -> Texture:
    """Printed page: title, paragraphs of words, and a small figure."""
    image = np.full((rows, columns, 3), (0.93, 0.93, 0.91), np.float32)
    image[24:32, 40 : columns - 60] = 0.15
    for top in range(46, rows - 20, 7):
        left = 18
        while left < columns - 24:
            word = int(rng.integers(5, 22))
            image[top : top + 3, left : min(left + word, columns - 18)] = 0.30
            left += word + 4
    figure = poster(rng, 0.1, 0.08, 900.0)
    top, left = int(rng.integers(50, rows - 110)), int(rng.integers(18, columns - 110))
    image[top : top + 72, left : left + 90] = figure[:72, :90]
    return image


def clock_face(size: int = 256) -> NDArray[np.float32]:
    """Wall clock at ten past ten, RGBA."""
    image = np.zeros((size, size, 4), np.float32)
    middle, radius = (size // 2, size // 2), size * 0.48
    cv2.circle(image, middle, int(radius), (0.10, 0.10, 0.12, 1.0), -1, cv2.LINE_AA)
    cv2.circle(image, middle, int(radius * 0.87), (0.95, 0.95, 0.92, 1.0), -1, cv2.LINE_AA)

    def hand(turn: float, inner: float, outer: float, thick: int) -> None:
        direction = np.asarray((np.sin(2 * np.pi * turn), -np.cos(2 * np.pi * turn))) * radius
        ends = [tuple(int(m + r * d) for m, d in zip(middle, direction, strict=True)) for r in (inner, outer)]
        cv2.line(image, ends[0], ends[1], (0.08, 0.08, 0.10, 1.0), thick, cv2.LINE_AA)

    for tick in range(60):
        hand(tick / 60, 0.70 if tick % 5 == 0 else 0.78, 0.82, 5 if tick % 5 == 0 else 2)
    hand(10.17 / 12, -0.08, 0.42, 9)
    hand(10 / 60, -0.10, 0.64, 6)
    return image


def plant(rng: np.random.Generator, size: int = 320) -> NDArray[np.float32]:
    """Potted plant: bent leaves in many greens over a terracotta pot, RGBA."""
    image = np.zeros((size, size, 4), np.float32)
    root = np.asarray((size * 0.5, size * 0.70))
    for i in range(60):
        lean = rng.normal(0.0, 0.62)
        length = size * rng.uniform(0.32, 0.62) * (1.0 - 0.25 * abs(lean))
        shade = (0.35 + 0.65 * i / 60) * rng.uniform(0.8, 1.1)
        colour = (0.22 * shade, 0.55 * shade, 0.18 * shade, 1.0)
        along = np.linspace(0.0, 1.0, 12)[:, None]
        tip = np.asarray((np.sin(lean), -np.cos(lean))) * length
        middle = root + along * tip + along**2 * np.asarray((0.0, abs(lean) * 0.25 * size))
        half = size * 0.030 * np.sin(np.pi * along**0.8) * np.asarray((np.cos(lean), np.sin(lean)))
        leaf = np.concatenate([middle + half, (middle - half)[::-1]]).astype(np.int32)
        cv2.fillPoly(image, [leaf], colour, cv2.LINE_AA)
        cv2.polylines(image, [middle.astype(np.int32)], False, (0.35 * shade, 0.66 * shade, 0.28 * shade, 1.0), 1)
    for y in range(int(size * 0.68), size - 2):
        rim = y < size * 0.75
        half = size * (0.19 if rim else 0.165 - 0.05 * (y / size - 0.75) / 0.25)
        x = np.arange(int(size * 0.5 - half), int(size * 0.5 + half))
        light = 1.05 - 0.55 * np.abs((x - size * 0.42) / half) ** 1.6 - (0.0 if rim else 0.06)
        image[y, x, :3] = np.clip(np.asarray((0.72, 0.36, 0.22)) * light[:, None], 0, 1)
        image[y, x, 3] = 1.0
    return image


def orange(rng: np.random.Generator, size: int = 128) -> NDArray[np.float32]:
    """Orange with pores, lit from above, RGBA."""
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) * (2.0 / (size - 1)) - 1.0
    r2 = x**2 + y**2
    z = np.sqrt(np.clip(1.0 - r2, 0.0, 1.0))
    light = 0.35 + 0.75 * np.clip(-0.25 * x - 0.7 * y + 0.65 * z, 0.0, 1.0)
    pores = 1.0 + 0.12 * fractal_noise(rng, size, size, (30, 30), 2)
    gloss = 0.5 * np.clip(1.0 - ((x + 0.22) ** 2 + (y + 0.48) ** 2) / 0.05, 0.0, 1.0)
    rgb = np.asarray((0.98, 0.56, 0.10)) * (light * pores)[..., None] + gloss[..., None]
    alpha = np.clip((1.0 - np.sqrt(r2)) * size / 4, 0.0, 1.0)
    return np.asarray(np.clip(np.dstack([rgb, alpha]), 0.0, 1.0), np.float32)


def football(size: int = 160) -> NDArray[np.float32]:
    """Football with twelve black patches, RGBA; lit from the viewer, so that it can turn in the picture."""
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) * (2.0 / (size - 1)) - 1.0
    r2 = x**2 + y**2
    z = np.sqrt(np.clip(1.0 - r2, 0.0, 1.0))
    golden = (1.0 + 5.0**0.5) / 2.0
    corner = np.asarray([(0.0, a, b) for a in (-1.0, 1.0) for b in (-golden, golden)])
    corners = np.concatenate([np.roll(corner, shift, axis=1) for shift in range(3)])  # of an icosahedron
    directions = corners / np.linalg.norm(corners[0])
    turned = directions @ cv2.Rodrigues(np.asarray((0.35, 0.2, 0.1)))[0].T
    nearest = (np.stack([x, y, z], axis=-1) @ turned.T.astype(np.float32)).max(axis=-1)
    light = 0.35 + 0.6 * z
    rgb = np.where(nearest > 0.93, np.float32(0.08), np.float32(0.95)) * light
    alpha = np.clip((1.0 - np.sqrt(r2)) * size / 4, 0.0, 1.0)
    return np.asarray(np.dstack([rgb, rgb, rgb, alpha]), np.float32)


def balloon(size: int = 320) -> NDArray[np.float32]:
    """Red balloon with a knot, RGBA."""
    image = np.zeros((size, round(0.72 * size), 4), np.float32)
    middle, (across, down) = (round(0.36 * size), round(0.43 * size)), (0.34 * size, 0.42 * size)
    y, x = np.mgrid[0 : image.shape[0], 0 : image.shape[1]].astype(np.float32)
    x, y = (x - middle[0]) / across, (y - middle[1]) / down
    r2 = x**2 + y**2
    z = np.sqrt(np.clip(1.0 - r2, 0.0, 1.0))
    light = 0.35 + 0.65 * np.clip(-0.3 * x - 0.6 * y + 0.7 * z, 0.0, 1.0)
    gloss = 0.7 * np.clip(1.0 - ((x + 0.35) ** 2 + (y + 0.45) ** 2) / 0.03, 0.0, 1.0)
    image[..., :3] = np.clip(np.asarray((0.86, 0.10, 0.14)) * light[..., None] + gloss[..., None], 0.0, 1.0)
    image[..., 3] = np.clip((1.0 - np.sqrt(r2)) * size / 6, 0.0, 1.0)
    knot = np.asarray(((0.36, 0.83), (0.32, 0.92), (0.40, 0.92))) * size
    cv2.fillPoly(image, [knot.astype(np.int32)], (0.55, 0.06, 0.09, 1.0), cv2.LINE_AA)
    return image
