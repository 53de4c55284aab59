"""Occupancy map of the demo against its known geometry, and time and memory on sequences, as Markdown.

``python benchmarks/occupancy.py --seqs demo fr1_rpy crowd_rpy`` runs each sequence once with the default configuration
and the occupancy map. With octomap-python installed, the same views are also inserted into an OctoMap.
"""

from __future__ import annotations

import importlib
import math
import os
import tempfile
import time
from functools import partial
from pathlib import Path

import columns
import torch
from command import make_parser, publish
from demo_surfaces import body_points, seen_points, static_surfaces
from heading import make_heading
from sequences import locate_sequence, table_name
from storage import Measurement, Row
from tables import flat
from timing import timed
from torch import Tensor

from v3d_torch.config.loading import load_config
from v3d_torch.datasets import RGBDSequence, load_sequence
from v3d_torch.datasets.demo.renderer import Renderer
from v3d_torch.datasets.demo.scenes import SCENES
from v3d_torch.datasets.demo.sequence import CAMERA, FRAME_RATE, SEED
from v3d_torch.errors import V3DError
from v3d_torch.evaluation.ate import align
from v3d_torch.geometry.cell_keys import cell_keys
from v3d_torch.geometry.se3 import invert
from v3d_torch.occupancy.occupancy_io import save_occupancy
from v3d_torch.occupancy.occupancy_map import VoxelState
from v3d_torch.occupancy.occupancy_mapper import OccupancyMapper
from v3d_torch.occupancy.octomap_file import write_octomap
from v3d_torch.pipeline import Pipeline
from v3d_torch.runtime.process import set_num_threads
from v3d_torch.segmentation import make_segmenter
from v3d_torch.slam import V3DSLAM

FIGURES = {1: "walking person", 2: "swaying person"}
"""Name of each moving figure of the demo, by its mask id."""

NEIGHBOURS = torch.cartesian_prod(*3 * [torch.tensor([-1, 0, 1])])


def run(sequence: RGBDSequence) -> tuple[Pipeline, OccupancyMapper]:
    """Run the system with an occupancy map over a sequence."""
    config = load_config(overrides=["occupancy.enabled=true"])
    set_num_threads(config.threads)
    slam = V3DSLAM(sequence.camera, make_segmenter(config, sequence.camera), config)
    pipeline = Pipeline(sequence, slam, evaluate_masks=False)
    pipeline()
    pipeline.flush()
    assert slam.occupancy is not None  # noqa: S101
    return pipeline, slam.occupancy


def compare_with_demo(sequence: RGBDSequence, pipeline: Pipeline, mapper: OccupancyMapper) -> list[Row]:
    """Compare the map of the demo with its geometry, voxel by voxel."""
    occupancy, scene = mapper.map, SCENES["demo"](SEED)
    size, trajectory, truth = occupancy.config.voxel_size, pipeline.slam.poses.trajectory(), sequence.groundtruth
    assert truth is not None  # noqa: S101
    T_eg = invert(align(truth.T_wc, trajectory.T_wc, oriented=True).T_ge)

    def keys_of(points: Tensor) -> Tensor:
        return cell_keys(((points @ T_eg[:3, :3].T + T_eg[:3, 3]) / size).floor().to(torch.int64))

    surface = keys_of(static_surfaces(scene)).unique()
    occupied, free = (_voxels(points, size) for points in (occupancy.occupied_points, occupancy.free_points))
    has_surface = torch.isin(cell_keys(occupied), surface)
    near_surface = torch.isin(cell_keys((occupied[:, None] + NEIGHBOURS).reshape(-1, 3)), surface)
    near_surface = near_surface.reshape(-1, len(NEIGHBOURS)).any(dim=1)
    free_right = ~torch.isin(cell_keys(free), surface)
    renderer, interval = Renderer(scene, CAMERA), occupancy.config.interval
    seen = [seen_points(renderer, sequence[i], occupancy.config.max_depth) for i in range(0, len(sequence), interval)]
    seen_keys, pixels = torch.cat([keys_of(points) for points in seen]).unique(return_counts=True)
    state = _states_of(seen_keys, occupied, free)
    known, right = state != VoxelState.UNKNOWN, state == VoxelState.OCCUPIED
    sampled = pixels >= occupancy.config.stride**2
    area_right = int(pixels[known & right].sum()) / int(pixels[known].sum())
    truly_free = int(free_right.sum()) + int((~has_surface).sum())
    rows = {
        "voxels that are called free and contain no surface": _share(free_right),
        "voxels that are called occupied, with a surface in them or in a neighbour": _share(near_surface),
        "voxels that are called occupied and contain a surface": _share(has_surface),
        "known voxels without surface that are called free": f"{int(free_right.sum()) / truly_free:.2%}",
        "surface that was seen, by area, in voxels that are called occupied": f"{area_right:.2%}",
        "voxels of which at least a sample was seen that are called occupied": _share(right[known & sampled]),
    }
    for instance, name in FIGURES.items():
        times = [index / FRAME_RATE for index in range(len(sequence))]
        bodies = [body for body in scene.bodies if body.instance == instance]
        swept = torch.cat([keys_of(body_points(body, t)).unique() for body in bodies for t in times]).unique()
        left = torch.isin(cell_keys(occupied), swept) & ~near_surface
        rows[f"voxels that the {name} passed and that are called occupied"] = f"{int(left.sum())} of {len(swept)}"
    floor = mapper.find_floor()
    if floor is not None:
        up = T_eg[:3, 2]
        below = T_eg[:3, :3] @ torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64) + T_eg[:3, 3]
        rows["floor: error of the up direction"] = f"{math.degrees(math.acos(min(float(floor.up @ up), 1.0))):.1f} deg"
        rows["floor: error of the height in the middle of the room"] = f"{float(floor.height(below)):.3f} m"
    return [{"quantity": quantity, "value": value} for quantity, value in rows.items()]


def _voxels(points: Tensor, size: float) -> Tensor:
    return (points / size).floor().to(torch.int64)


def _states_of(keys: Tensor, occupied: Tensor, free: Tensor) -> Tensor:
    """States of the voxels with the given keys."""
    states = torch.where(torch.isin(keys, cell_keys(free)), VoxelState.FREE, VoxelState.UNKNOWN)
    return torch.where(torch.isin(keys, cell_keys(occupied)), VoxelState.OCCUPIED, states)


def _share(mask: Tensor) -> str:
    return f"{float(mask.double().mean()):.2%} of {len(mask)}"


def measure_costs(pipeline: Pipeline, mapper: OccupancyMapper) -> Row:
    """Measure time and memory of the map of a run, and the time of its queries."""
    occupancy, times = mapper.map, pipeline.record.times
    cpu = 1e3 * times.cpu[:, times.stages.index("occupancy")]
    state = mapper.state_dict()
    views = state["store"]["views"]
    memory = occupancy.blocks.log_odds.nbytes + sum(view.depth_units.nbytes + view.static.nbytes for view in views)
    points = occupancy.free_points
    points = points[:: max(len(points) // 1000, 1)][:1000]
    queries = {
        "free": partial(occupancy.is_free, points, 0.2),
        "tree": lambda: occupancy.distance(points[:1]),
        "distance": partial(occupancy.distance, points),
        "floor": mapper.find_floor,
    }
    milliseconds = {name: 1e3 * timed(query, time.process_time)[0] for name, query in queries.items()}
    with tempfile.TemporaryDirectory() as folder:
        save_occupancy(Path(folder) / "map.npz", occupancy)
        write_octomap(Path(folder) / "map.bt", occupancy)
        sizes = [f"{(Path(folder) / name).stat().st_size / 1e3:.0f}" for name in ("map.npz", "map.bt")]
    return {
        "sequence": table_name(pipeline.sequence),
        "cpu_ms": f"{float(cpu.mean()):.2f}",
        "cpu_ms_95": f"{float(cpu.quantile(0.95)):.1f}",
        "octomap_ms": octomap_time(pipeline, mapper),
        "voxels": f"{len(occupancy.occupied_points)} / {len(occupancy.free_points)}",
        "memory_mb": f"{memory / 1e6:.1f}",
        "files_kb": " / ".join(sizes),
        "queries_ms": " / ".join(f"{milliseconds[name]:.1f}" for name in queries),
    }


def octomap_time(pipeline: Pipeline, mapper: OccupancyMapper) -> str:
    """Return the CPU time per frame in which OctoMap inserts the same views, ms; "-" without octomap-python."""
    try:
        octomap = importlib.import_module("octomap")
    except ImportError:
        return "-"
    config, store = mapper.map.config, mapper.state_dict()["store"]
    tree = octomap.OcTree(config.voxel_size)
    seconds = 0.0
    for view, T_dw in zip(store["views"], store["T_dw"], strict=True):
        rays, depth, T_wd = view.rays(pipeline.sequence.camera, config.stride), view.depth, invert(T_dw)
        valid = (depth > 0) & (depth <= config.max_depth) & view.static
        points = (rays[valid] * depth[valid][:, None]).to(torch.float64) @ T_wd[:3, :3].T + T_wd[:3, 3]
        insert = partial(tree.insertPointCloud, points.numpy(), T_wd[:3, 3].numpy(), lazy_eval=True)
        seconds += timed(insert, time.process_time)[0]
    return f"{1e3 * seconds / len(store['views']) / config.interval:.2f}"


def main() -> None:
    """Run every sequence and print its tables."""
    parser = make_parser("Occupancy map of the demo against its geometry, and costs, as Markdown.")
    parser.add_argument("--seqs", nargs="+", default=["demo", "fr1_rpy", "crowd_rpy"], help="sequences to run")
    options = parser.parse_args()
    heading = make_heading(("octomap-python",))
    lines = list(heading.lines())
    truth_rows: list[Row] = []
    cost_rows: list[Row] = []
    try:
        for name in options.seqs:
            sequence = load_sequence(locate_sequence(name, options.data_root), data_root=options.data_root)
            pipeline, mapper = run(sequence)
            cost_rows.append(measure_costs(pipeline, mapper))
            if name == "demo":
                truth_rows = compare_with_demo(sequence, pipeline, mapper)
                lines += ["", "## demo", "", *flat(truth_rows, columns.OCCUPANCY)]
    except V3DError as error:
        parser.error(str(error))
    lines += ["", f"## Costs on {os.cpu_count()} cores", "", *flat(cost_rows, columns.OCCUPANCY_COSTS)]
    measurements = {"occupancy_costs": Measurement(heading, cost_rows)}
    if truth_rows:
        measurements["occupancy"] = Measurement(heading, truth_rows)
    publish(lines, options, parser, measurements)


if __name__ == "__main__":
    main()
