"""Figures written by a run: trajectory, masks, occupancy map, votes and clusters."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from v3d_torch.geometry.camera import BackProjector
from v3d_torch.objects.frame_objects import TrackedObject
from v3d_torch.pipeline import Pipeline
from v3d_torch.pipeline.run_record import Snapshot
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runs.file_names import RunFile
from v3d_torch.types import Instances, Trajectory
from v3d_torch.viz.clusters import Cluster, save_clusters_figure
from v3d_torch.viz.figure_output import save_figure
from v3d_torch.viz.object_overlay import Overlay, save_mask_figure
from v3d_torch.viz.objects_figure import draw_objects_from_above
from v3d_torch.viz.occupancy_figure import draw_occupancy
from v3d_torch.viz.trajectory_figure import save_trajectory_figure
from v3d_torch.viz.voting import save_voting_figure


@torch.inference_mode()  # some figures call stages, with tensors of a run in this mode
def draw_run(folder: Path, pipeline: Pipeline, trajectory: Trajectory, point_map: PointMap) -> None:
    """Draw trajectory, masks, objects, occupancy map, and votes and clouds of the most dynamic frame, if there are any.

    Args:
        folder: Folder of the results.
        pipeline: Pipeline after the run.
        trajectory: Poses of all frames.
        point_map: Static map.

    Raises:
        OutputError: If an image cannot be written.
    """
    sequence, record = pipeline.sequence, pipeline.record
    poses = pipeline.slam.poses
    groundtruth = sequence.groundtruth if poses.was_found else None  # lost poses cannot be aligned to it
    save_trajectory_figure(groundtruth, trajectory, folder / RunFile.TRAJECTORY_FIGURE, sequence.name, poses.statuses)
    if record.snapshots:
        images = [snapshot.frame.image for snapshot in record.snapshots]
        overlays = [[_overlay(obj) for obj in snapshot.result.objects] for snapshot in record.snapshots]
        save_mask_figure(images, overlays, folder / RunFile.MASKS_FIGURE)
    if len(record.objects):
        figure = draw_objects_from_above(record.objects, trajectory, point_map.points, pipeline.slam.up, sequence.name)
        save_figure(figure, folder / RunFile.OBJECTS_FIGURE)
    mapper = pipeline.slam.occupancy
    if mapper is not None and not mapper.map.is_empty:
        up, floor = mapper.up.direction, mapper.find_floor()
        save_figure(draw_occupancy(mapper.map, trajectory, up, floor, sequence.name), folder / RunFile.OCCUPANCY_FIGURE)
    snapshot = record.most_dynamic_snapshot
    if snapshot is not None and snapshot.result.vote_pairs:
        _draw_votes(folder / RunFile.VOTING_FIGURE, pipeline, snapshot, _title(snapshot, trajectory))
    if snapshot is not None and (clusters := _clusters(pipeline, snapshot)):
        save_clusters_figure(clusters, folder / RunFile.CLUSTERS_FIGURE, _title(snapshot, trajectory))


def _draw_votes(path: Path, pipeline: Pipeline, snapshot: Snapshot, title: str) -> None:
    camera, T_cw = pipeline.sequence.camera, snapshot.T_cw
    objects: dict[int, Overlay] = {}
    centres: dict[int, Tensor] = {}
    for obj in snapshot.result.objects:
        mask, label, motion_state = _overlay(obj)
        votes = f": {obj.votes} {'vote' if obj.votes == 1 else 'votes'}" if obj.votes else ""
        objects[obj.id] = (mask, f"{label}{votes}", motion_state)
        centroid = T_cw[:3, :3] @ obj.centroid + T_cw[:3, 3]
        # Without points the centroid is a prediction; that of an object that was never measured is NaN.
        if mask.any() and len(obj.cloud) and centroid[2] > 0:
            centres[obj.id] = camera.distort(camera.project(centroid[None]))[0]
    save_voting_figure(snapshot.frame.image, objects, centres, snapshot.result.vote_pairs, path, title)


def _clusters(pipeline: Pipeline, snapshot: Snapshot) -> list[Cluster]:
    """Compute clouds from the refined masks of the results, with the points that outlier rejection removes.

    The votes used clouds of the masks of the network.
    """
    detected = [obj for obj in snapshot.result.objects if not obj.missed]
    if not detected:
        return []
    slam, count = pipeline.slam, len(detected)
    masks = torch.stack([obj.mask for obj in detected])
    labels = torch.tensor([obj.label for obj in detected])
    depth = slam.smooth_depth(snapshot.frame.depth[None])[0]
    clouds = slam.back_project_instances(depth, Instances(masks, labels, torch.ones(count), torch.zeros(count, 4)))
    points = BackProjector(pipeline.sequence.camera)(depth[None])[0]
    measured = (depth[0] > 0) & (depth[0] <= slam.config.objects.clouds.max_depth)
    return [
        Cluster(
            label=obj.name,
            before=points[obj.mask & measured],
            inliers=clouds.cloud_pixels[i][obj.mask & measured],
            after=clouds.points[i, clouds.valid[i]],
        )
        for i, obj in enumerate(detected)
        if clouds.centroid[i].isfinite().all()
    ]


def _overlay(obj: TrackedObject) -> Overlay:
    return obj.mask, obj.name, obj.motion_state.value


def _title(snapshot: Snapshot, trajectory: Trajectory) -> str:
    seconds = snapshot.frame.stamp - float(trajectory.stamps[0])
    return f"frame {snapshot.frame.index}, {seconds:.3f} s after the first frame"
