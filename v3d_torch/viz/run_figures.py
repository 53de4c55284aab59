"""The figures that every run leaves behind."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.geometry.camera import BackProjector
from v3d_torch.objects.frame_objects import TrackedObject
from v3d_torch.pipeline import Pipeline, Snapshot
from v3d_torch.types import Instances, Trajectory
from v3d_torch.viz.clusters import Cluster, clusters_figure
from v3d_torch.viz.figures import Overlay, mask_strip, trajectory_figure
from v3d_torch.viz.voting import voting_figure


def draw_run(folder: Path, pipeline: Pipeline, trajectory: Trajectory) -> None:
    """Draw the trajectory, the masks, and of the liveliest frame the votes and the clouds, where it has any.

    Args:
        folder: for the images.
        pipeline: that has run.
        trajectory: of all frames.

    Raises:
        OutputError: when an image cannot be written.
    """
    trajectory_figure(pipeline.sequence.groundtruth, trajectory, folder / "trajectory.png", pipeline.sequence.name)
    if snapshots := pipeline.record.snapshots:
        overlays = [[_overlay(judged) for judged in shot.scene.objects] for shot in snapshots]
        mask_strip([shot.frame.image for shot in snapshots], overlays, folder / "masks.png")
    shot = pipeline.record.most_dynamic_snapshot
    if shot is not None and shot.scene.vote_pairs:
        _draw_votes(folder / "voting.png", pipeline, shot)
    if shot is not None and (clusters := _clusters(pipeline, shot)):
        clusters_figure(clusters, folder / "clusters.png", _title(shot))


def _draw_votes(path: Path, pipeline: Pipeline, shot: Snapshot) -> None:
    camera, T_cw = pipeline.sequence.camera, shot.T_cw
    objects: dict[int, Overlay] = {}
    centres: dict[int, Tensor] = {}
    for judged in shot.scene.objects:
        mask, text, verdict = _overlay(judged)
        votes = f": {judged.votes} {'vote' if judged.votes == 1 else 'votes'}" if judged.votes else ""
        objects[judged.id] = (mask, f"{text}{votes}", verdict)
        in_camera = T_cw[:3, :3] @ judged.centroid + T_cw[:3, 3]
        if mask.any() and in_camera[2] > 0:  # in view, and neither unknown, which is nan, nor behind the camera
            centres[judged.id] = camera.distort(camera.project(in_camera[None]))[0]
    voting_figure(shot.frame.image, objects, centres, shot.scene.vote_pairs, path, _title(shot))


def _clusters(pipeline: Pipeline, shot: Snapshot) -> list[Cluster]:
    """The clouds of a frame's objects once more, with what outlier rejection took away."""
    seen = [judged for judged in shot.scene.objects if not judged.missed]
    if not seen:
        return []
    slam, count = pipeline.slam, len(seen)
    masks = torch.stack([judged.mask for judged in seen])
    labels = torch.tensor([judged.label for judged in seen])
    depth = slam.smooth_depth(shot.frame.depth[None])[0]
    clouds = slam.back_project_instances(depth, Instances(masks, labels, torch.ones(count), torch.zeros(count, 4)))
    points = BackProjector(pipeline.sequence.camera)(depth[None])[0]
    lifted = (depth[0] > 0) & (depth[0] <= slam.config.objects.clouds.max_depth)
    return [
        Cluster(
            text=_overlay(judged)[1],
            before=points[judged.mask & lifted],
            kept=clouds.cloud_pixels[i][judged.mask & lifted],
            after=clouds.points[i, clouds.valid[i]],
        )
        for i, judged in enumerate(seen)
        if clouds.centroid[i].isfinite().all()
    ]


def _overlay(judged: TrackedObject) -> Overlay:
    return judged.mask, judged.name, judged.motion_state.value


def _title(shot: Snapshot) -> str:
    return f"frame {shot.frame.index}, {shot.frame.stamp:.3f} s"
