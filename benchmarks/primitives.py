"""Times of the primitives of the object stage beside scikit-learn, Open3D, SciPy, Kornia and torch.cdist.

``python benchmarks/primitives.py`` prints a table for one thread and one for two. All implementations get the same
clouds and take turns in random order, so that a busy machine slows all of them. A time is the median over the turns;
``ratio`` is the median of the peer's time divided by ours in the same turn: above 1 ours is faster. It needs open3d and
scikit-learn.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from statistics import median

import numpy as np
import open3d as o3d
import sklearn.cluster
import torch
import typer
from heading import make_heading
from kornia.filters import joint_bilateral_blur
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform
from storage import Measurement, Row
from storage import save as store
from timing import OURS, Implementations, take_turns

from v3d_torch.geometry.depth_smoother import smooth_depth
from v3d_torch.geometry.voxel import voxel_pool
from v3d_torch.objects.chamfer import chamfer_distance
from v3d_torch.objects.dbscan import dbscan
from v3d_torch.objects.largest_clusters import largest_clusters
from v3d_torch.objects.voting import hough_vote

SIZES = [(5, 500), (5, 5000), (50, 500), (50, 5000)]
"""Number of instances (of one frame, and of ten) and number of points of each after pooling."""
VOXEL, EPS, MIN_SAMPLES = 0.02, 0.08, 5
"""Edge of a voxel and radius of DBSCAN in metres, and neighbours of a core point: the defaults of the package."""


def surfaces(batch: int, count: int, spacing: float, seed: int = 0) -> np.ndarray:
    """Sample wavy surfaces at 2 m every ``spacing`` metres, with the noise of a depth camera."""
    side = int(np.ceil(np.sqrt(count)))
    v, u = (axis.ravel()[:count] * spacing for axis in np.mgrid[:side, :side])
    sheet = np.stack([u, v, 2 + 0.1 * np.sin(5 * u)], axis=-1)
    return sheet + np.random.default_rng(seed).normal(0, 0.005, (batch, count, 3))


def tensors(clouds: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Convert clouds to the format of the stage: float32 points with a mask."""
    return torch.from_numpy(clouds.astype(np.float32)), torch.ones(clouds.shape[:2], dtype=torch.bool)


def open3d_cloud(points: np.ndarray) -> o3d.geometry.PointCloud:
    """Convert points to a cloud of Open3D."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def smoothing() -> Implementations:
    """Depth smoothing, on an image with a fifth of its depth missing."""
    generator = torch.Generator().manual_seed(0)
    depth = 2 + 0.2 * torch.rand(1, 1, 480, 640, generator=generator)
    depth[torch.rand(depth.shape, generator=generator) < 0.2] = 0
    guide = torch.where(depth > 0, depth.clamp(min=0.1).log(), 1e3)
    return {
        OURS: lambda: smooth_depth(depth),
        "Kornia joint bilateral": lambda: joint_bilateral_blur(depth, guide, 5, 0.05, (1.0, 1.0)),
    }


def pooling(batch: int, count: int) -> Implementations:
    """Voxel pooling to about ``count`` points: nine per cell of the surface, spread over two voxels."""
    clouds = surfaces(batch, count * 9 // 2, VOXEL / 3)
    points, valid = tensors(clouds)
    return {
        OURS: lambda: voxel_pool(points, valid, VOXEL),
        "Open3D": lambda: [np.asarray(open3d_cloud(cloud).voxel_down_sample(VOXEL).points) for cloud in clouds],
    }


def clustering(batch: int, count: int) -> Implementations:
    """DBSCAN, on pooled clouds."""
    clouds = surfaces(batch, count, VOXEL)
    points, valid = tensors(clouds)
    peer = sklearn.cluster.DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, n_jobs=torch.get_num_threads())
    return {
        OURS: lambda: dbscan(points, valid, EPS, MIN_SAMPLES),
        "scikit-learn": lambda: [peer.fit(cloud).labels_ for cloud in clouds],
        "Open3D": lambda: [np.asarray(open3d_cloud(cloud).cluster_dbscan(EPS, MIN_SAMPLES)) for cloud in clouds],
    }


def selecting(batch: int, count: int) -> Implementations:
    """Selection of the largest cluster, among six clusters and noise."""
    labels = torch.from_numpy(np.random.default_rng(0).integers(-1, 6, (batch, count)))
    valid = torch.ones_like(labels, dtype=torch.bool)
    return {
        OURS: lambda: largest_clusters(labels, valid),
        "NumPy": lambda: [row == np.bincount(row[row >= 0]).argmax() for row in labels.numpy()],
    }


def comparing(batch: int, count: int) -> Implementations:
    """Chamfer distance between two samplings of the same surface."""
    previous, current = surfaces(batch, count, VOXEL, seed=1), surfaces(batch, count, VOXEL, seed=2)
    p, q = tensors(previous)[0], tensors(current)[0]

    def scipy_chamfer(a: np.ndarray, b: np.ndarray) -> float:
        workers = torch.get_num_threads()
        return float(sum(np.square(cKDTree(y).query(x, workers=workers)[0]).mean() for x, y in [(a, b), (b, a)]))

    def open3d_chamfer(a: np.ndarray, b: np.ndarray) -> float:
        a, b = open3d_cloud(a), open3d_cloud(b)
        return float(sum(np.square(x.compute_point_cloud_distance(y)).mean() for x, y in [(a, b), (b, a)]))

    def cdist_chamfer(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        squares = torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist").square()
        return squares.amin(dim=1).mean() + squares.amin(dim=0).mean()

    implementations: Implementations = {
        OURS: lambda: chamfer_distance(p, q),
        "SciPy": lambda: [scipy_chamfer(*pair) for pair in zip(previous, current, strict=True)],
        "Open3D": lambda: [open3d_chamfer(*pair) for pair in zip(previous, current, strict=True)],
    }
    if batch * count**2 < 1e9:  # larger inputs take seconds per turn
        implementations["torch.cdist"] = lambda: [cdist_chamfer(*pair) for pair in zip(p, q, strict=True)]
    return implementations


def voting() -> Implementations:
    """Hough voting, with ten objects."""
    points_a, points_b = np.random.default_rng(0).random((2, 10, 3))
    previous, current = torch.from_numpy(points_a), torch.from_numpy(points_b)
    present = torch.ones(10, dtype=torch.bool)
    return {
        OURS: lambda: hough_vote(previous, current, present, 0.05, 2),
        "SciPy": lambda: squareform(np.abs(pdist(points_b) - pdist(points_a)) >= 0.05).sum(axis=1) >= 2,
    }


def problems() -> Iterator[tuple[str, str, Implementations]]:
    """Yield primitive, size and implementations, ours first."""
    yield "smooth_depth", "640 x 480", smoothing()
    for batch, count in SIZES:
        size = f"{batch} x {count}"
        yield "voxel_pool", size, pooling(batch, count)
        yield "dbscan", size, clustering(batch, count)
        yield "largest_clusters", size, selecting(batch, count)
        yield "chamfer_distance", size, comparing(batch, count)
    yield "hough_vote", "10 objects", voting()


def main(
    threads: int = typer.Option(0, min=0, help="Threads of every implementation; 0 runs with one, then with two."),
    turns: int = typer.Option(11, min=1, help="Minimum number of turns."),
    save: bool = typer.Option(False, "--save", help="Store the rows in benchmarks/results."),
) -> None:
    """Measure all primitives and print a table for each number of threads."""
    if threads == 0:
        for number in (1, 2):
            # A new process, because OpenMP reads its settings once. PASSIVE: each library has its own OpenMP, whose
            # idle threads would otherwise spin on the core that the next implementation needs.
            settings = {"OMP_NUM_THREADS": str(number), "OMP_WAIT_POLICY": "PASSIVE"}
            command = [sys.executable, __file__, "--threads", str(number), "--turns", str(turns)]
            command += ["--save"] if save else []
            subprocess.run(command, check=True, env=os.environ | settings)  # noqa: S603 (this file itself)
        return

    heading = make_heading()
    rows: list[Row] = []
    torch.set_num_threads(threads)
    table = Table("primitive", "size", "implementation", "ms", "ratio", title=f"threads: {threads}")
    for name, size, implementations in problems():
        times = take_turns(implementations, turns)
        for implementation, values in times.items():
            head = (name, size) if implementation == OURS else ("", "")
            ratio = median(theirs / ours for theirs, ours in zip(values, times[OURS], strict=True))
            cells = {"implementation": implementation, "ms": f"{median(values):.2f}", "ratio": f"{ratio:.2f}"}
            rows.append({"primitive": name, "size": size, "threads": str(threads)} | cells)
            table.add_row(*head, *cells.values())
        table.add_section()
    Console().print(table)
    if save:
        store("primitives", Measurement(heading, rows))


if __name__ == "__main__":
    typer.run(main)
