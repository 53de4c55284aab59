"""People in the coloured map, with and without the free-space check, and time and size of maps, as Markdown.

``python benchmarks/maps.py --seqs crowd_rpy walkers_room`` runs each sequence once with the default configuration.
Sequences need ``masks/`` with the true people.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import columns
import torch
from command import make_parser, publish
from heading import make_heading
from sequences import locate_sequence, table_name
from storage import Measurement, Row
from tables import flat
from timing import timed
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.datasets.base import HasMotionMasks
from v3d_torch.errors import InputError, V3DError
from v3d_torch.mapping.map_io import load_map, save_map
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.reconstruction.mesh import fuse_mesh
from v3d_torch.reconstruction.point_map import fuse_points
from v3d_torch.segmentation import make_segmenter
from v3d_torch.slam import V3DSLAM

NO_CHECK = load_config(overrides=["objects.free_space.min_tolerance=1000"])
"""Configuration in which no point counts as free space."""


def run(sequence: RGBDSequence) -> tuple[V3DSLAM, StaticViews, dict[str, StaticViews]]:
    """Run the system over a sequence.

    Returns:
        The system, its views, and views whose colour is the true mask: white for people.

    Raises:
        InputError: If a frame has no true mask.
    """
    config = Config()
    slam = V3DSLAM(sequence.camera, make_segmenter(config, sequence.camera), config)
    views, masked, unmasked = (StaticViews(sequence.camera, config.dense_map.stride) for _ in range(3))
    for frame in sequence:
        objects = slam(frame)
        keyframe = slam.map.newest_keyframe_at(frame.stamp)
        if keyframe is None:
            continue
        truth = sequence.motion_mask(frame.index) if isinstance(sequence, HasMotionMasks) else None
        if truth is None:
            raise InputError(f"{sequence.name}: frame {frame.index} has no true mask; choose another sequence")
        white = ((truth > 0) & (truth < 255)).to(torch.uint8).mul(255).expand(3, -1, -1)
        static, motion = objects.map_mask, (frame.depth_delay, objects.T_dc)
        views.add(keyframe, frame.image, frame.depth, static, *motion)
        masked.add(keyframe, white, frame.depth, static, *motion)
        unmasked.add(keyframe, white, frame.depth, torch.ones_like(static), *motion)
    slam.flush()
    return slam, views, {"classified as static": masked, "all": unmasked}


def count_people(sequence: str, people: dict[str, StaticViews]) -> Iterator[Row]:
    """Yield a row per selection of pixels: points and people among them, without and with the free-space check."""
    for pixels, views in people.items():
        before, after = is_person(views, NO_CHECK), is_person(views, Config())
        lost = 1 - int((~after).sum()) / max(int((~before).sum()), 1)
        yield {
            "sequence": sequence,
            "pixels": pixels,
            "points_before": str(len(before)),
            "people_before": f"{int(before.sum())} ({float(before.double().mean()):.2%})",
            "points_after": str(len(after)),
            "people_after": f"{int(after.sum())} ({float(after.double().mean()):.2%})",
            "static_lost": f"{lost:.2%}",
        }


def is_person(views: StaticViews, config: Config) -> Tensor:
    """Fuse views whose colour is the true mask, and return which points belong to people, bool, shape (N,)."""
    return fuse_points(views, config).colours[:, 0] > 127


def measure_costs(sequence: RGBDSequence, slam: V3DSLAM, views: StaticViews) -> Row:
    """Measure CPU time and size of each product."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.map"
        points, cloud = timed(lambda: fuse_points(views, slam.config), time.process_time)
        faces, mesh = timed(lambda: fuse_mesh(views, slam.config.dense_map), time.process_time)
        saving, _ = timed(lambda: save_map(path, slam.map, views), time.process_time)
        loading, _ = timed(lambda: load_map(path, sequence.camera, slam.config), time.process_time)
        return {
            "sequence": table_name(sequence),
            "keyframes": str(len(views)),
            "points": f"{len(cloud)} in {points:.1f} s",
            "triangles": f"{len(mesh.faces)} in {faces:.1f} s",
            "saving": f"{saving:.1f} s, {path.stat().st_size / 1e6:.0f} MB",
            "loading": f"{loading:.1f} s",
        }


def main() -> None:
    """Run every sequence and print its tables."""
    parser = make_parser("People in the coloured map, and time and size of maps, as Markdown.")
    parser.add_argument("--seqs", nargs="+", default=["crowd_rpy", "walkers_room"], help="sequences with true masks")
    options = parser.parse_args()
    heading = make_heading()
    lines = list(heading.lines())
    people_rows: list[Row] = []
    cost_rows: list[Row] = []
    torch.set_num_threads(1)
    try:
        for name in options.seqs:
            sequence = load_sequence(locate_sequence(name, options.data_root), data_root=options.data_root)
            slam, views, people = run(sequence)
            rows = list(count_people(table_name(sequence), people))
            costs = measure_costs(sequence, slam, views)
            lines += ["", f"## {name}", "", *flat(rows, columns.MAPS)]
            lines += ["", f"CPU time on {os.cpu_count()} cores: " + "; ".join(f"{k} {v}" for k, v in costs.items())]
            people_rows += rows
            cost_rows.append(costs)
    except V3DError as error:
        parser.error(str(error))
    measurements = {"maps": Measurement(heading, people_rows), "map_costs": Measurement(heading, cost_rows)}
    publish(lines, options, parser, measurements)


if __name__ == "__main__":
    main()
