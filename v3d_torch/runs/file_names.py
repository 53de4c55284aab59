"""Names of the files and folders that a run writes."""

from __future__ import annotations

from enum import StrEnum

FIGURES = "figures"
"""Folder of the figures."""

MASKS = "masks"
"""Folder of an image per frame of the pixels that tracking excludes."""

MAP_MASKS = "map_masks"
"""Folder of an image per frame of the pixels that maps exclude."""


class RunFile(StrEnum):
    """Files that a run, or the report of a run, writes, other than an image per frame."""

    LOG = "run.log"
    """Log, which every run writes first: a folder with this file contains results of a run."""
    TRAJECTORY = "trajectory.txt"
    KEYFRAMES = "keyframes.txt"
    GROUNDTRUTH = "groundtruth.txt"
    CONFIG = "config.yaml"
    REQUEST = "request.yaml"
    """Options of the run, written before its first frame."""
    METRICS = "metrics.json"
    REPORT = "report.html"
    CHECKPOINT = "checkpoint.v3d"
    """State of the run. It exists from the first checkpoint of a run to its end."""
    FRAMES = "frames.parquet"
    STATES = "states.parquet"
    OBJECTS = "objects.parquet"
    MAP = "map.ply"
    MESH = "mesh.ply"
    CAMERA_PATH = "trajectory.ply"
    OCCUPANCY = "occupancy.npz"
    OCTOMAP = "occupancy.bt"
    GRID_IMAGE = "map.pgm"
    """Image of the 2D grid, written with its description."""
    GRID = "map.yaml"
    OCCUPANCY_FIGURE = f"{FIGURES}/occupancy.png"
    TRAJECTORY_FIGURE = f"{FIGURES}/trajectory.png"
    MASKS_FIGURE = f"{FIGURES}/masks.png"
    VOTING_FIGURE = f"{FIGURES}/voting.png"
    CLUSTERS_FIGURE = f"{FIGURES}/clusters.png"
    OBJECTS_FIGURE = f"{FIGURES}/objects.png"
