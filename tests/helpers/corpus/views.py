"""Intact image files with content that cannot be tracked."""

from __future__ import annotations

import numpy as np

from helpers.corpus.base import HEIGHT, WIDTH, camera_position, colour, depth, png
from helpers.corpus.case import Case, Fails, Succeeds, Workspace, all_of, edit, fails_after_run, replace_text, write
from helpers.corpus.images import DEPTH, RGB, every
from helpers.corpus.lists import lines


def plain(value: int) -> bytes:
    """Colour image with a single grey value."""
    return png(np.full((HEIGHT, WIDTH, 3), value, np.uint8))


def still(listed: list[str]) -> list[str]:
    """Give every line the pose of the first one."""
    return [f"{line.split()[0]} {listed[0].split(maxsplit=1)[1]}" for line in listed]


def covered(place: Workspace) -> None:
    """Write 30 frames, of which the middle 20 are black and without depth: the camera is covered."""
    for kind in ("rgb", "depth"):
        lines = []
        for i in range(30):
            stamp = f"{1305031102 + i / 10:.6f}"
            x, y = camera_position(min(i, 4)) if i < 25 else camera_position(min(i - 20, 7))
            images = {
                "rgb": plain(0) if 5 <= i < 25 else png(colour(x, y)),
                "depth": png(depth(0.0 if 5 <= i < 25 else 1.0)),
            }
            (place.folder / kind / f"{stamp}.png").write_bytes(images[kind])
            lines.append(f"{stamp} {kind}/{stamp}.png\n")
        (place.folder / f"{kind}.txt").write_text("".join(lines))
    (place.folder / "groundtruth.txt").unlink()


UNIFORM = (
    "seq: the camera was not found in any of the 8 frames, the colour images are uniform; record it"
    " again, with light and an uncovered lens"
)
NO_DEPTH = (
    "seq: the camera was not found in any of the 8 frames, the depth images are empty; record or export them again"
)

CASES = [
    Case(
        "all black",
        every(RGB, lambda i: plain(0)),
        fails_after_run(UNIFORM),
    ),
    Case(
        "all white",
        every(RGB, lambda i: plain(255)),
        fails_after_run(UNIFORM),
    ),
    Case(
        "no depth",
        every(DEPTH, lambda i: png(depth(0.0))),
        fails_after_run(NO_DEPTH),
    ),
    Case(
        "saturated depth",
        every(DEPTH, lambda i: png(np.full((HEIGHT, WIDTH), 65535, np.uint16))),
        fails_after_run(NO_DEPTH),
    ),
    Case(
        "depth in a corner only",
        every(DEPTH, lambda i: png(depth() * (np.indices((HEIGHT, WIDTH)).max(axis=0) < 10))),
        fails_after_run(
            "seq: the camera was not found in any of the 8 frames, at most 0.81% of the pixels have depth; record again"
            " within the range of the depth camera, or export the depth again"
        ),
    ),
    Case(
        "images of 64x48 pixels",
        all_of(
            every(RGB, lambda i: png(colour(*camera_position(i))[:48, :64])),
            every(DEPTH, lambda i: png(depth()[:48, :64])),
            edit("camera.yaml", replace_text("width: 128", "width: 64")),
            edit("camera.yaml", replace_text("height: 96", "height: 48")),
        ),
        fails_after_run(
            "seq: the camera was not found in any of the 8 frames, images of 64x48 pixels have too few features; use"
            " images of at least 96 rows and columns"
        ),
    ),
    Case(
        "black without depth",
        all_of(every(RGB, lambda i: plain(0)), every(DEPTH, lambda i: png(depth(0.0)))),
        fails_after_run(UNIFORM),
    ),
    Case(
        "depth in metres",
        every(DEPTH, lambda i: png(np.full((HEIGHT, WIDTH), 1, np.uint16))),
        Fails(
            "{seq}: the median depth of the first frame is 0.0002 m at 5000 units per metre; correct the"
            " camera's depth_scale (1000 if depth is in millimetres) or the depth images"
        ),
    ),
    Case(
        "depth in millimetres",
        every(DEPTH, lambda i: png(np.full((HEIGHT, WIDTH), 1000, np.uint16))),
        Succeeds(max_ate=0.1, note="the ground truth is 5.01 times as large as the estimate: check depth_scale"),
    ),
    Case(
        "depth scale of one unit per metre",
        edit("camera.yaml", replace_text("5000", "1")),
        Fails(
            "{seq}: the median depth of the first frame is 5e+03 m at 1 units per metre; correct the camera's"
            " depth_scale (1000 if depth is in millimetres) or the depth images"
        ),
    ),
    Case(
        "identical images",
        all_of(every(RGB, lambda i: png(colour(*camera_position(0)))), lines("groundtruth.txt", still)),
        Succeeds(),
    ),
    Case("one black frame", write(RGB[4], plain(0)), Succeeds(lost=1, max_ate=0.03)),
    Case("one frame without depth", write(DEPTH[4], png(depth(0.0))), Succeeds()),
    Case("first frame black", write(RGB[0], plain(0)), Succeeds(lost=1, max_ate=0.03)),
    Case("camera covered for two seconds", covered, Succeeds(30, lost=20, max_ate=None)),
]
