"""Times of the object stage's primitives beside scikit-learn, Open3D, SciPy, Kornia and torch.cdist.

``python benchmarks/objects.py`` prints one table for one thread and one for two. All competitors get the same clouds
and take turns in random order, so that a busy machine slows them alike. A time is the median over the turns; ``ratio``
is the median of the peer's time over ours in the same turn: above 1 we are faster. Needs open3d and scikit-learn.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any

import numpy as np
import open3d as o3d
import sklearn.cluster
import torch
import typer
from kornia.filters import joint_bilateral_blur
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.objects.chamfer import chamfer_distance
from v3d_torch.objects.dbscan import dbscan
from v3d_torch.objects.largest_clusters import largest_clusters
from v3d_torch.objects.voting import hough_vote

OURS = "v3d_torch"
SIZES = [(5, 500), (5, 5000), (50, 500), (50, 5000)]
"""Instances of one frame and of ten, and points of each after pooling."""
VOXEL, EPS, MIN_SAMPLES = 0.02, 0.08, 5

Competitors = dict[str, Callable[[], Any]]


def surfaces(batch: int, count: int, spacing: float, seed: int = 0) -> np.ndarray:
    """Wavy sheets 2 m away, sampled every ``spacing`` metres, with a depth camera's noise."""
    side = int(np.ceil(np.sqrt(count)))
    v, u = (axis.ravel()[:count] * spacing for axis in np.mgrid[:side, :side])
    sheet = np.stack([u, v, 2 + 0.1 * np.sin(5 * u)], axis=-1)
    return sheet + np.random.default_rng(seed).normal(0, 0.005, (batch, count, 3))


def tensors(clouds: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Clouds as the stage passes them on: float32, with a mask."""
    return torch.from_numpy(clouds.astype(np.float32)), torch.ones(clouds.shape[:2], dtype=torch.bool)


def open3d_cloud(points: np.ndarray) -> o3d.geometry.PointCloud:
    """A cloud of Open3D."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def smoothing() -> Competitors:
    """An image with a fifth of its depth missing."""
    generator = torch.Generator().manual_seed(0)
    depth = 2 + 0.2 * torch.rand(1, 1, 480, 640, generator=generator)
    depth[torch.rand(depth.shape, generator=generator) < 0.2] = 0
    guide = torch.where(depth > 0, depth.clamp(min=0.1).log(), 1e3)
    return {
        OURS: lambda: smooth_depth(depth),
        "Kornia joint bilateral": lambda: joint_bilateral_blur(depth, guide, 5, 0.05, (1.0, 1.0)),
    }


def pooling(batch: int, count: int) -> Competitors:
    """Nine points to a cell of the sheet, which the noise shares out to two voxels: ``count`` are left."""
    clouds = surfaces(batch, count * 9 // 2, VOXEL / 3)
    points, valid = tensors(clouds)
    return {
        OURS: lambda: voxel_pool(points, valid, VOXEL),
        "Open3D": lambda: [np.asarray(open3d_cloud(cloud).voxel_down_sample(VOXEL).points) for cloud in clouds],
    }


def clustering(batch: int, count: int) -> Competitors:
    """Clouds as they come out of the voxels."""
    clouds = surfaces(batch, count, VOXEL)
    points, valid = tensors(clouds)
    peer = sklearn.cluster.DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, n_jobs=torch.get_num_threads())
    return {
        OURS: lambda: dbscan(points, valid, EPS, MIN_SAMPLES),
        "scikit-learn": lambda: [peer.fit(cloud).labels_ for cloud in clouds],
        "Open3D": lambda: [np.asarray(open3d_cloud(cloud).cluster_dbscan(EPS, MIN_SAMPLES)) for cloud in clouds],
    }


def selecting(batch: int, count: int) -> Competitors:
    """Six clusters and noise."""
    labels = torch.from_numpy(np.random.default_rng(0).integers(-1, 6, (batch, count)))
    valid = torch.ones_like(labels, dtype=torch.bool)
    return {
        OURS: lambda: largest_clusters(labels, valid),
        "NumPy": lambda: [row == np.bincount(row[row >= 0]).argmax() for row in labels.numpy()],
    }


def comparing(batch: int, count: int) -> Competitors:
    """Two samplings of the same surface."""
    then, now = surfaces(batch, count, VOXEL, seed=1), surfaces(batch, count, VOXEL, seed=2)
    p, q = tensors(then)[0], tensors(now)[0]

    def scipy_chamfer(a: np.ndarray, b: np.ndarray) -> float:
        workers = torch.get_num_threads()
        return float(sum(np.square(cKDTree(y).query(x, workers=workers)[0]).mean() for x, y in [(a, b), (b, a)]))

    def open3d_chamfer(a: np.ndarray, b: np.ndarray) -> float:
        a, b = open3d_cloud(a), open3d_cloud(b)
        return float(sum(np.square(x.compute_point_cloud_distance(y)).mean() for x, y in [(a, b), (b, a)]))

    def cdist_chamfer(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        squares = torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist").square()
        return squares.amin(dim=1).mean() + squares.amin(dim=0).mean()

    competitors: Competitors = {
        OURS: lambda: chamfer_distance(p, q),
        "SciPy": lambda: [scipy_chamfer(*pair) for pair in zip(then, now, strict=True)],
        "Open3D": lambda: [open3d_chamfer(*pair) for pair in zip(then, now, strict=True)],
    }
    if batch * count**2 < 1e9:  # beyond, a turn takes seconds and nothing new is learned
        competitors["torch.cdist"] = lambda: [cdist_chamfer(*pair) for pair in zip(p, q, strict=True)]
    return competitors


def voting() -> Competitors:
    """Ten objects, two frames."""
    then, now = np.random.default_rng(0).random((2, 10, 3))
    previous, current, present = torch.from_numpy(then), torch.from_numpy(now), torch.ones(10, dtype=torch.bool)
    return {
        OURS: lambda: hough_vote(previous, current, present, 0.05, 2),
        "SciPy": lambda: squareform(np.abs(pdist(now) - pdist(then)) >= 0.05).sum(axis=1) >= 2,
    }


def contests() -> Iterator[tuple[str, str, Competitors]]:
    """Primitive, size, competitors with ours first."""
    yield "smooth_depth", "640 x 480", smoothing()
    for batch, count in SIZES:
        size = f"{batch} x {count}"
        yield "voxel_pool", size, pooling(batch, count)
        yield "dbscan", size, clustering(batch, count)
        yield "largest_clusters", size, selecting(batch, count)
        yield "chamfer_distance", size, comparing(batch, count)
    yield "hough_vote", "10 objects", voting()


def take_turns(competitors: Competitors, turns: int) -> dict[str, list[float]]:
    """Milliseconds of each in each turn; more turns than asked for where they are short."""
    times: dict[str, list[float]] = {name: [] for name in competitors}
    shuffler = np.random.default_rng(0)  # or the one who comes after the slowest would always find a cold cache
    end = time.perf_counter() + 1
    while len(times[OURS]) <= turns or time.perf_counter() < end:
        for name in shuffler.permutation(list(competitors)):
            start = time.perf_counter()
            competitors[name]()
            times[name].append(1e3 * (time.perf_counter() - start))
    return {name: values[1:] for name, values in times.items()}  # the first warms up


def main(
    threads: int = typer.Option(0, min=0, help="Threads to give to everyone; 0 runs with one, then with two."),
    turns: int = typer.Option(11, min=1, help="Measurements per competitor, at least."),
) -> None:
    """Print a table of times for each number of threads."""
    if threads == 0:
        for number in (1, 2):
            # A process each, since OpenMP reads its settings once. Each library brings its own OpenMP, whose idle
            # threads would spin on the core that the next competitor needs.
            settings = {"OMP_NUM_THREADS": str(number), "OMP_WAIT_POLICY": "PASSIVE"}
            command = [sys.executable, __file__, "--threads", str(number), "--turns", str(turns)]
            subprocess.run(command, check=True, env=os.environ | settings)  # noqa: S603 (this file itself)
        return

    torch.set_num_threads(threads)
    table = Table("primitive", "size", "competitor", "ms", "ratio", title=f"threads: {threads}")
    for name, size, competitors in contests():
        times = take_turns(competitors, turns)
        for competitor, values in times.items():
            head = (name, size) if competitor == OURS else ("", "")
            ratio = median(theirs / ours for theirs, ours in zip(values, times[OURS], strict=True))
            table.add_row(*head, competitor, f"{median(values):.2f}", f"{ratio:.2f}")
        table.add_section()
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
