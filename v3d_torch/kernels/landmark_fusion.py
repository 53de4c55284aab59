"""Kernels of landmark fusion; see `v3d_torch.mapping.landmark_fusion` and `v3d_torch.mapping.landmark_ids`."""

from __future__ import annotations

import math

import numpy as np

from v3d_torch.kernels.arrays import Bools, Floats, Ints, Words
from v3d_torch.kernels.compiler import device, kernel
from v3d_torch.kernels.landmark_projection import project
from v3d_torch.kernels.projection_matching import match_by_projection


@device
def _find_candidates(landmarks: Ints, own: Ints, active: Bools) -> Ints:
    """Ids of the active landmarks among ``landmarks`` that are not among ``own``, ascending; -1 is no landmark."""
    is_candidate = np.zeros(len(active), np.bool_)
    for i in landmarks:
        if i >= 0:
            is_candidate[i] = active[i]
    for i in own:
        if i >= 0:
            is_candidate[i] = False
    return np.flatnonzero(is_candidate)


@kernel(
    "(i8[::1], i8[::1], b1[::1], f8[:,::1], f8[:,::1], f8[::1], u8[:,::1], u8[:,::1], i8[::1], f8[:,::1], f8[::1],"
    "f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], i8, i8, f8, f8, f8, i8, f8, f8, f8, f8, f8, f8)"
)
def find_matches(
    landmarks: Ints, own: Ints, active: Bools, points: Floats, directions: Floats, reference_distance: Floats,
    landmark_descriptors: Words, descriptors: Words, octave: Ints, uv: Floats, depth: Floats, sigma_ratio: Floats,
    T_cw: Floats, K: Floats, bounds: Floats, first_octave: int, last_octave: int, scale: float, radius: float,
    cell: float, max_hamming: int, max_ratio: float, pixel_sigma: float, inverse_depth_sigma: float,
    chi2_without_depth: float, chi2_with_depth: float, min_depth: float,
) -> Ints:  # fmt: skip
    """Landmark that matches each feature of a keyframe, with a small reprojection error, -1 for none, (N,).

    Args:
        landmarks: Ids of the landmarks to match, -1 for none, in any order.
        own: Landmark of each feature, -1 for none, (N,); these landmarks are not matched again.
        active: Mask of the landmarks of the map that are in use, (L,).
        points: Landmarks of the map, world frame, (L, 3).
        directions: Unit viewing directions of the first observations, world frame, (L, 3).
        reference_distance: Distances at which the landmarks appear at octave 0, metres, (L,).
        landmark_descriptors: Descriptors of the landmarks, (L, 4).
        descriptors: Descriptors of the features, (N, 4).
        octave: Octaves of the features, (N,).
        uv: Pixels of the features, at least one, (N, 2).
        depth: Depth of the features, metres, (N,); 0 = not measured.
        sigma_ratio: Relative standard deviations of pixel and inverse depth, (N, 2).
        T_cw: World-to-camera pose of the keyframe, (4, 4).
        K: Camera matrix, (3, 3).
        bounds: Bounds of a landmark in view, (2, 5), see `project`.
        first_octave: Octave of the finest pyramid level.
        last_octave: Octave of the coarsest pyramid level.
        scale: Scale factor between octaves.
        radius: Search radius at octave 0, pixels.
        cell: Side of the cells of the search grid, pixels.
        max_hamming: Maximum Hamming distance, bits.
        max_ratio: Maximum ratio of the best to the second-best distance.
        pixel_sigma: Standard deviation of u and of v at octave 0, pixels.
        inverse_depth_sigma: Standard deviation of inverse depth, 1/m.
        chi2_without_depth: Maximum squared whitened residual of a feature without depth.
        chi2_with_depth: Maximum squared whitened residual of a feature with depth.
        min_depth: Depth of a landmark in front of the camera, metres.
    """
    ids = _find_candidates(landmarks, own, active)
    rows, projected, z, expected = project(
        T_cw, points[ids], directions[ids], reference_distance[ids], K, bounds, math.log(scale), first_octave,
        last_octave,
    )  # fmt: skip
    ids, radii = ids[rows], radius * scale ** expected.astype(np.float64)
    pairs = match_by_projection(
        projected, radii, expected, landmark_descriptors[ids], uv, octave, descriptors, max_hamming, max_ratio, cell
    )
    matches = np.full(len(uv), -1)
    for pair in pairs:
        k, i = pair[0], pair[1]
        sigma = pixel_sigma * scale ** float(octave[i]) * sigma_ratio[i, 0]
        r0, r1, r2 = (projected[k, 0] - uv[i, 0]) / sigma, (projected[k, 1] - uv[i, 1]) / sigma, 0.0
        threshold = chi2_without_depth
        if depth[i] > 0:
            r2 = (1 / z[k] - 1 / depth[i]) / (inverse_depth_sigma * sigma_ratio[i, 1])
            threshold = chi2_with_depth
        if z[k] > min_depth and r0 * r0 + r1 * r1 + r2 * r2 <= threshold:
            matches[i] = ids[k]
    return matches


@kernel("(i8[::1], i8[::1], i8[::1], i8[::1], b1[::1], i8, i8)")
def find_mergeable(
    kept: Ints, merged: Ints, keyframe: Ints, landmark: Ints, valid: Bools, keyframe_count: int, landmark_count: int
) -> tuple[Bools, Ints]:
    """Mask of the pairs of landmarks that no keyframe observes both, (P,), and observations of their second ones, (R,).

    Args:
        kept: First landmark of each pair, (P,).
        merged: Second landmark of each pair, (P,). No id occurs twice in ``kept`` and ``merged``.
        keyframe: Keyframe of each observation, (M,).
        landmark: Landmark of each observation, (M,).
        valid: Mask of the observations that are not outliers, (M,).
        keyframe_count: Number of keyframes.
        landmark_count: Number of landmarks.
    """
    pair_of = np.full(landmark_count, -1)
    for p in range(len(kept)):
        pair_of[kept[p]] = pair_of[merged[p]] = p
    is_mergeable, rows, count = np.ones(len(kept), np.bool_), np.empty(len(landmark), np.int64), 0
    is_observed = np.zeros((len(kept), keyframe_count), np.bool_)
    for m in range(len(landmark)):
        p = pair_of[landmark[m]]
        if p < 0 or not valid[m]:
            continue
        if is_observed[p, keyframe[m]]:
            is_mergeable[p] = False
        is_observed[p, keyframe[m]] = True
        if landmark[m] == merged[p]:
            rows[count] = m
            count += 1
    rows = rows[:count]
    return is_mergeable, rows[is_mergeable[pair_of[landmark[rows]]]]
