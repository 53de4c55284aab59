"""How much of the maps is people, with and without the look through free space; how long maps take, and their files.

``python benchmarks/maps.py crowd_rpy walkers_room`` runs each sequence once with the default configuration and
prints Markdown. Sequences need ``masks/`` with the true people.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import torch
import typer
from torch import Tensor

from v3d_torch.config import Config
from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.datasets.base import HasMotionMasks
from v3d_torch.mapping.map_io import load_map, save_map
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.reconstruction.mesh import fuse_mesh
from v3d_torch.reconstruction.point_map import fuse_points
from v3d_torch.segmentation import make_segmenter
from v3d_torch.slam import V3DSLAM

TRUSTING = load_config(overrides=["objects.free_space.min_tolerance=1000"])
"""Nothing is ever looked through."""

Made = TypeVar("Made")


def main(
    seqs: Annotated[list[str], typer.Argument(help="Sequences with masks.")],
    data_root: Annotated[Path | None, typer.Option(envvar="V3D_DATA", help="Where they are.")] = None,
) -> None:
    """Print a table per sequence."""
    torch.set_num_threads(1)
    for name in seqs:
        sequence = load_sequence(name, data_root=data_root)
        slam, views, people = run(sequence)
        print(f"\n{name}: {len(sequence)} frames, {len(views)} keyframes\n")
        print("| pixels in the map | points | people | looked through taken out: points | people | static lost |")
        print("|---|---:|---:|---:|---:|---:|")
        for what, truth in people.items():
            print(f"| {what} | {shares(truth)} |")
        print(f"\n{times(sequence, slam, views)}")


def run(sequence: RGBDSequence) -> tuple[V3DSLAM, StaticViews, dict[str, StaticViews]]:
    """The system over a sequence.

    Returns:
        The system, its views, and views whose colour is the true mask: white where a person is.
    """
    config = Config()
    slam = V3DSLAM(sequence.camera, make_segmenter(config.segmentation), config)
    views, masked, every = (StaticViews(sequence.camera, config.dense_map.stride) for _ in range(3))
    for frame in sequence:
        scene = slam(frame)
        keyframes = slam.mapper.map.keyframes
        if not keyframes or keyframes[-1].frame != frame.index:
            continue
        truth = sequence.motion_mask(frame.index) if isinstance(sequence, HasMotionMasks) else None
        if truth is None:
            raise typer.BadParameter(f"{sequence.name} has no mask for frame {frame.index}")
        white = ((truth > 0) & (truth < 255)).to(torch.uint8).mul(255).expand(3, -1, -1)
        views.add(keyframes[-1], frame.image, frame.depth, scene.static_without_people)
        masked.add(keyframes[-1], white, frame.depth, scene.static_without_people)
        every.add(keyframes[-1], white, frame.depth, torch.ones_like(scene.static_without_people))
    return slam, views, {"what the system takes for static": masked, "all": every}


def shares(truth: StaticViews) -> str:
    """Cells of a row: points and people among them, before and after, and what is static and went."""

    def people(config: Config) -> Tensor:
        return fuse_points(truth, config).colours[:, 0] > 127

    before, after = people(TRUSTING), people(Config())
    lost = 1 - int((~after).sum()) / max(int((~before).sum()), 1)
    cells = [f"{len(found)} | {int(found.sum())} ({float(found.double().mean()):.2%})" for found in (before, after)]
    return " | ".join([*cells, f"{lost:.2%}"])


def times(sequence: RGBDSequence, slam: V3DSLAM, views: StaticViews) -> str:
    """Seconds of this process for each product."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "room.map"
        points, cloud = clocked(lambda: fuse_points(views, slam.config))
        faces, mesh = clocked(lambda: fuse_mesh(views, slam.config.dense_map))
        saving, _ = clocked(lambda: save_map(path, slam.mapper.map, views))
        loading, _ = clocked(lambda: load_map(path, sequence.camera, slam.config))
        return (
            f"map.ply {points:.1f} s ({len(cloud)} points), mesh.ply {faces:.1f} s ({len(mesh.faces)} triangles),"
            f" saving the map {saving:.1f} s ({path.stat().st_size / 1e6:.0f} MB), loading it {loading:.1f} s;"
            f" CPU time, {os.cpu_count()} cores"
        )


def clocked(make: Callable[[], Made]) -> tuple[float, Made]:
    """CPU seconds that something takes, and the thing."""
    start = time.process_time()
    made = make()
    return time.process_time() - start, made


if __name__ == "__main__":
    typer.run(main)
