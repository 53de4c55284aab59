"""Columns of the tables that benchmarks print and the page shows: headings by the cell of a row."""

from __future__ import annotations

GROWTH = {
    "sequence": "sequence",
    "frames": "frames",
    "cpu_ms": "CPU ms per frame",
    "cpu_ratio": "relative to a new system",
    "memory_mb": "memory, MB",
    "memory_kb_per_frame": "growth, kB per frame",
    "keyframes": "keyframes",
    "loops": "loops",
}

KEYFRAMES = {
    "keyframes": "keyframes",
    "add_ms": "add one, ms",
    "query_ms": "query, ms",
    "pose_graph_s": "pose graph, s",
    "error_before": "error before, m",
    "error_after": "error after, m",
}

CONSISTENCY = {
    "sequence": "sequence",
    "configuration": "configuration",
    "poses": "poses",
    "nees": "NEES, expected 6",
    "bounds": "95% bounds of NEES",
    "first": "NEES of the first 40 poses",
    "median": "median, expected 5.3",
    "within": "below the 95% bound",
    "position": "position, expected 3",
    "rotation": "rotation, expected 3",
    "groundtruth": "noise of the ground truth",
}

LIVE = {
    "sequence": "sequence",
    "frames": "frames",
    "pose_latency_median": "latency of poses, median, ms",
    "pose_latency_p95": "95% below, ms",
    "latency_median": "latency of results, median, ms",
    "latency_p95": "95% below, ms",
    "dropped": "frames dropped",
    "ate": "ATE, m",
    "offline": "ATE with every frame, m",
}

LOST = {
    "sequence": "sequence",
    "interruption": "interruption",
    "recovery": "frames to recover",
    "unflagged": "covered but tracked",
    "found": "reliable poses",
    "ate": "ATE, m",
    "ratio": "relative to uninterrupted",
    "worst": "worst error, m",
    "reference_worst": "uninterrupted, m",
    "passes": "passes",
}

CALIBRATION = {
    "sequence": "sequence",
    "change": "wrong in the camera file",
    "parameter": "parameter",
    "right": "right",
    "given": "given",
    "estimated": "estimated",
    "result": "result",
}

DEGRADED = {
    "sequence": "sequence",
    "degradation": "degradation",
    "ours": "v3d_torch, ATE, m",
    "peer": "ORB-SLAM3 (PyPI), ATE, m",
}

HELD_OUT = {
    "sequence": "sequence",
    "change": "wrong in the camera file",
    "accepted": "accepted from the first half",
    "right": "right camera, ATE, m",
    "given": "wrong camera, ATE, m",
    "calibrated": "calibrated camera, ATE, m",
}

PLAUSIBILITY = {
    "sequence": "sequence",
    "frames": "frames",
    "change": "wrong",
    "result": "result",
    "warnings": "warnings",
}

SEGMENTATION = {
    "network": "network",
    "ms": "ms",
    "people_found": "people's pixels found",
    "moving_masked": "moving masked",
    "static_masked": "static masked",
    "id_switches": "ID switches",
    "ate": "ATE, m",
}

MAPS = {
    "sequence": "sequence",
    "pixels": "pixels in the map",
    "points_before": "points",
    "people_before": "people",
    "points_after": "points with check",
    "people_after": "people with check",
    "static_lost": "static points lost",
}

MAP_COSTS = {
    "sequence": "sequence",
    "keyframes": "keyframes",
    "points": "points",
    "triangles": "triangles",
    "saving": "saving",
    "loading": "loading",
}

OCCUPANCY = {"quantity": "map of the demo", "value": "result"}

OCCUPANCY_COSTS = {
    "sequence": "sequence",
    "cpu_ms": "CPU ms per frame",
    "cpu_ms_95": "95th percentile",
    "octomap_ms": "OctoMap, CPU ms per frame",
    "voxels": "voxels occupied / free",
    "memory_mb": "memory, MB",
    "files_kb": "npz / bt, kB",
    "queries_ms": "1000 free balls / search tree / 1000 distances / floor, CPU ms",
}

PRIMITIVES = {
    "primitive": "primitive",
    "size": "size",
    "threads": "threads",
    "implementation": "implementation",
    "ms": "ms",
    "ratio": "ratio",
}

MODULES = {
    "function": "function",
    "batch": "batch",
    "implementation": "implementation",
    "ms": "ms",
    "ratio": "ratio",
    "error": "error",
}

DESIGN_CHOICES = {"choice": "choice", "sequence": "sequence", "result": "result", "commit": "commit"}

TRACKS = {
    "sequence": "sequence",
    "tracker": "tracker",
    "hota": "HOTA",
    "deta": "DetA",
    "assa": "AssA",
    "idf1": "IDF1",
    "mota": "MOTA",
    "id_switches": "ID switches in 60 frames (all)",
    "pixels_right": "people's pixels in the right track",
    "tracks": "tracks (people)",
    "position": "position error, cm",
    "velocity": "velocity error, m/s",
    "velocity_from_truth": "from true positions, m/s",
    "nees": "normalised errors of position and velocity, expected 3",
    "positions": "positions",
}

FEATURE_UNCERTAINTY = {
    "sequence": "sequence",
    "train": "learnt from",
    "frames": "frames",
    "default": "equal uncertainties, ATE, m",
    "learnt": "learnt uncertainties, ATE, m",
    "ratios": "learnt / equal, each seed",
}

VOTING_THRESHOLDS = {
    "sequence": "sequence",
    "train": "learnt from",
    "rule": "rule",
    "numbers": "T_d and T_v",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
}
