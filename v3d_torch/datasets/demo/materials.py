"""Procedural textures of materials, made of fractal noise and drawn shapes, with corners at every scale.

All textures are RGB in [0, 1], float32, shape :math:`(H, W, 3)`. Sizes are in metres, densities in texels per metre.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]
Colour = tuple[float, float, float]


def texels(metres: float, density: float) -> int:
    """Return the number of texels that cover a length in metres, at least 8."""
    return max(8, round(metres * density))


def fractal_noise(
    rng: np.random.Generator, height: int, width: int, cells: tuple[float, float] = (4.0, 4.0), octaves: int = 5
) -> NDArray[np.float32]:
    """Generate fractal noise: a sum of octaves of value noise (Perlin, 1985) with zero mean and about unit range.

    Args:
        rng: Random generator.
        height: Number of rows.
        width: Number of columns.
        cells: Lattice cells of the coarsest octave along the height and the width.
        octaves: Number of octaves; each doubles the frequency and halves the amplitude.

    Returns:
        Noise, float32, shape :math:`(H, W)`.
    """
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        lattice = tuple(int(min(n, max(2, c * 2**octave))) for n, c in zip((height, width), cells, strict=True))
        values = rng.uniform(-1.0, 1.0, lattice).astype(np.float32)
        total += cv2.resize(values, (width, height), interpolation=cv2.INTER_CUBIC) * 0.5**octave
    return np.asarray(total / 1.5, np.float32)


def tint(colour: Colour, value: NDArray[np.float32]) -> Texture:
    """Multiply a colour by a brightness factor per texel."""
    return np.asarray(np.clip(np.asarray(colour, np.float32) * value[..., None], 0.0, 1.0), np.float32)


def plaster(rng: np.random.Generator, width: float, height: float, density: float, colour: Colour) -> Texture:
    """Painted wall with stains, roller marks and small chips."""
    rows, columns = texels(height, density), texels(width, density)
    value = 1.0 + 0.10 * fractal_noise(rng, rows, columns, (3, 5), 7)
    chips = fractal_noise(rng, rows, columns, (rows / 14, columns / 14), 2)
    return tint(colour, value - 0.25 * (chips > 0.72))


def wood(
    rng: np.random.Generator, width: float, height: float, density: float, colour: Colour, board: float = 0.14
) -> Texture:
    """Wooden boards along the width, each with its own tone, grain, joint and knots."""
    rows, columns = texels(height, density), texels(width, density)
    image = np.zeros((rows, columns, 3), np.float32)
    step = texels(board, density)
    for top in range(0, rows, step):
        n = min(step, rows - top)
        grain = fractal_noise(rng, n, columns, (n / 5, max(2.0, columns / 220)), 4)
        tone = np.ones((n, columns), np.float32) * rng.uniform(0.82, 1.1)
        joint = int(rng.integers(columns))
        tone[:, joint:] *= rng.uniform(0.85, 1.12)
        tone[:, joint : joint + 2] *= 0.45
        tone[:1] *= 0.5
        for _ in range(rng.poisson(columns / 260)):
            centre = (int(rng.integers(columns)), int(rng.integers(n)))
            cv2.ellipse(
                tone, centre, (int(rng.integers(4, 9)), int(rng.integers(2, 5))), 0, 0, 360, 0.55, -1, cv2.LINE_AA
            )
        image[top : top + n] = tint(colour, tone * (1.0 + 0.30 * grain))
    return image


def bricks(rng: np.random.Generator, width: float, height: float, density: float, colour: Colour) -> Texture:
    """Brick wall in running bond: bricks of 0.24 m x 0.08 m with different tones and pores, and mortar."""
    rows, columns = texels(height, density), texels(width, density)
    value = np.zeros((rows, columns), np.float32)
    hue = np.zeros((rows, columns), np.float32)
    long, tall = texels(0.24, density), texels(0.08, density)
    joint = max(1, round(0.012 * density))
    for course, top in enumerate(range(0, rows, tall)):
        for left in range(-(course % 2) * long // 2, columns, long):
            box = np.s_[top : top + tall - joint, max(left, 0) : max(left + long - joint, 0)]
            value[box] = rng.uniform(0.72, 1.12)
            hue[box] = rng.uniform(-0.06, 0.06)
    mortar = value == 0.0
    value = value * (1.0 + 0.16 * fractal_noise(rng, rows, columns, (rows / 24, columns / 24), 4))
    image = tint(colour, value)
    image[..., 0] += hue
    image[..., 2] -= hue
    image[mortar] = np.asarray((0.78, 0.75, 0.70), np.float32)
    return np.clip(image * (1.0 + 0.06 * fractal_noise(rng, rows, columns, (4, 6), 6)[..., None]), 0.0, 1.0)


def terrazzo(rng: np.random.Generator, width: float, height: float, density: float, colour: Colour) -> Texture:
    """Terrazzo slabs of 0.4 m with chips of many colours."""
    rows, columns = texels(height, density), texels(width, density)
    image = tint(colour, 1.0 + 0.12 * fractal_noise(rng, rows, columns, (6, 6), 6))
    for _ in range(int(width * height * 550)):
        points = rng.normal(0.0, 0.011 * density, (5, 2)) + rng.random(2) * (columns, rows)
        shade = np.asarray(colour) * rng.uniform(0.35, 1.35) + rng.uniform(-0.08, 0.08, 3)
        cv2.fillConvexPoly(image, cv2.convexHull(points.astype(np.int32)), tuple(shade.clip(0, 1)), cv2.LINE_AA)
    return add_seams(image, texels(0.4, density))


def add_seams(image: Texture, step: int) -> Texture:
    """Darken every ``step``-th row and column of an image in place, as seams between slabs; return the image."""
    image[::step] *= 0.5
    image[:, ::step] *= 0.5
    return image


def cardboard(rng: np.random.Generator, width: float, height: float, density: float) -> Texture:
    """Side of a cardboard box with a strip of tape, a printed arrow and lines of text."""
    rows, columns = texels(height, density), texels(width, density)
    image = tint((0.70, 0.53, 0.35), 1.0 + 0.12 * fractal_noise(rng, rows, columns, (rows / 3, 3), 4))
    image[:, round(0.46 * columns) : round(0.54 * columns)] *= np.float32(1.18)
    ink = (0.22, 0.15, 0.10)
    arrow = np.asarray(
        ((0.14, 0.45), (0.22, 0.2), (0.30, 0.45), (0.25, 0.45), (0.25, 0.75), (0.19, 0.75), (0.19, 0.45))
    )
    cv2.fillPoly(image, [(arrow * (columns, rows)).astype(np.int32)], ink, cv2.LINE_AA)
    for line in np.arange(0.25, 0.8, 0.11):
        start, end = (0.62, line), (rng.uniform(0.72, 0.93), line)
        ends = [tuple((np.asarray(point) * (columns, rows)).astype(int).tolist()) for point in (start, end)]
        cv2.line(image, ends[0], ends[1], ink, max(1, rows // 40), cv2.LINE_AA)
    return np.clip(image, 0.0, 1.0)
