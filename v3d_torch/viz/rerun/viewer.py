"""Viewer that logs a run to rerun: camera, objects, votes, map, trajectory and curves."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import cv2
import numpy as np
import rerun as rr
import torch
from numpy.typing import NDArray
from torch import Tensor

from v3d_torch.errors import OutputError
from v3d_torch.evaluation.association import associate_trajectories
from v3d_torch.evaluation.evaluation import has_orientations
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.depth_units import depth_to_units
from v3d_torch.geometry.se3 import invert, transform_points
from v3d_torch.mapping.keyframe import Keyframe, stack_poses
from v3d_torch.objects.frame_objects import FrameObjects
from v3d_torch.reconstruction.point_map import PointMap
from v3d_torch.runtime.stage_timer import StageTime
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus, Trajectory
from v3d_torch.viz.camera_path import FRUSTUM_DEPTH
from v3d_torch.viz.rerun.layout import layout
from v3d_torch.viz.rerun.objects import format_objects, log_objects, motion_state_classes, rgba
from v3d_torch.viz.rerun.occupancy import log_floor, log_voxels

_LOG = logging.getLogger("v3d_torch")

_FLUSH_TIMEOUT = 30.0
"""Longest time to send the rest of the data to the viewer after the run, seconds."""

_MAP_GROWTH = 1.1
"""Ratio of the keyframe counts at which the whole map is logged again. In total, eleven times its size is logged."""

_JPEG_QUALITY = 80
_DEPTH_UNITS_PER_METRE = 1000
_IMAGE_PLANE_DEPTH = 0.3  # metres from the current camera to its drawn image


class RerunViewer:
    """Viewer that logs every frame on the timelines ``frame`` (frame index) and ``stamp`` (timestamp).

    ========================================  ==========================================================================
    ``world/camera``                          pose of the frame, T_wc
    ``world/camera/image``                    pinhole; below it ``rgb``, ``depth``, ``masks`` and boxes of ``objects``
    ``world/objects``, ``world/centroids``    clouds and centroids of the objects; their class is the motion state;
                                              ``boxes``; ``paths`` of the last seconds
    ``world/votes``                           lines of votes for dynamic objects; other votes: ``without_effect``
    ``world/map``                             ``landmarks`` and ``keyframes``; below them ``recent``: the part since the
                                              map was logged; ``points`` of the static scene, at the end
    ``world/occupancy``                       occupied voxels, logged with the map; ``floor``: free cells, at the end
    ``world/trajectory``                      all poses, logged with the map; ``recent``: poses since then up to the
                                              newest keyframe; ``newest``: poses since
    ``world/groundtruth``                     ground truth, aligned at the first pose that has one
    ``seconds``, ``votes``, ``chamfer``       curves, by stage and by object id
    ``frame_summary``, ``log``                status and objects of the frame, and events, as text
    ========================================  ==========================================================================

    The results of local bundle adjustment and loop closing for a keyframe are applied with the frame after it. The
    recent part is logged again then. The whole map and all poses are logged after a loop is closed, when the number of
    keyframes has grown by a tenth, and at the end: the recording grows in proportion to the run. The lens distortion is
    not shown: the image is logged as captured.

    Args:
        stream: Recording, from `open_stream`.
        camera: Camera of all frames.
        groundtruth: Ground-truth poses, or None. A ground truth without orientations is not shown, because it cannot be
            aligned at a single pose.
        name: Name of the sequence.
    """

    def __init__(
        self, stream: rr.RecordingStream, camera: PinholeCamera, groundtruth: Trajectory | None, name: str
    ) -> None:
        self._stream = stream
        self._camera = camera
        self._unaligned = groundtruth if groundtruth is not None and has_orientations(groundtruth) else None
        self._newest: list[NDArray[np.float64]] = []  # positions since the last keyframe, and the one before
        self._logged_keyframes = self._logged_frames = 0  # of the whole map, when it was logged
        self._pending_keyframe: Keyframe | None = None  # keyframe whose back-end result is not applied yet
        self._loops = 0
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.send_recording_name(name)
        truth = "ground truth aligned at the first pose" if self._unaligned is not None else "no ground truth"
        stream.send_blueprint(layout(f"World ({truth})"))
        stream.log("world", rr.ViewCoordinates.RDF, motion_state_classes(), static=True)
        size = [camera.width, camera.height]
        pinhole = rr.Pinhole(
            image_from_camera=camera.K.numpy(), resolution=size, image_plane_distance=_IMAGE_PLANE_DEPTH
        )
        stream.log("world/camera/image", pinhole, static=True)

    def show(
        self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM, stage_times: Mapping[str, StageTime]
    ) -> None:
        """Log a frame. The time this takes is recorded as the stage ``viewer``."""
        with slam.timer("viewer"):
            self._stream.set_time("frame", sequence=frame.index)
            self._stream.set_time("stamp", timestamp=frame.stamp)
            T_wc = invert(slam.poses.T_cw)
            self._log_camera(frame, T_wc)
            log_objects(self._stream, objects, slam.up)
            if self._pending_keyframe is not None:
                if self._is_map_due(slam):
                    self._log_map(slam)
                else:
                    self._log_recent(slam)
            else:
                self._newest.append(T_wc[:3, 3].numpy())
            self._pending_keyframe = slam.back_end.keyframe
            self._stream.log("world/trajectory/newest", _lines([np.array(self._newest)], "tab:blue"))
            self._log_groundtruth(frame.stamp, T_wc, slam.poses.status)
            for stage, spent in stage_times.items():
                self._stream.log(f"seconds/{stage}", rr.Scalars(spent.wall))
            self._log_text(frame, objects, slam)

    def finish(self, slam: V3DSLAM, point_map: PointMap) -> None:
        """Log the final map and poses, and close the file and the connection.

        Raises:
            OutputError: If the file could not be written completely.
        """
        self._log_map(slam)
        if slam.occupancy is not None and (grid := slam.occupancy.grid()) is not None:
            log_floor(self._stream, grid)
        points = rr.Points3D(point_map.points.numpy(), colors=point_map.colours.numpy())
        self._stream.log("world/map/points", points)
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT)
        except RuntimeError as error:
            if "gRPC" not in str(error):
                reason = f"the rerun recording is incomplete ({error}); free disk space, or choose another file"
                raise OutputError(reason) from error
            _LOG.warning("the viewer was closed: %s", error)  # not a failure of the run
        finally:
            self._stream.disconnect()

    def _log_camera(self, frame: RGBDFrame, T_wc: Tensor) -> None:
        pose = rr.Transform3D(translation=T_wc[:3, 3].numpy(), mat3x3=T_wc[:3, :3].numpy())
        self._stream.log("world/camera", pose)
        bgr = np.ascontiguousarray(frame.image.permute(1, 2, 0).numpy()[..., ::-1])
        jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        self._stream.log("world/camera/image/rgb", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        units, _ = depth_to_units(frame.depth, _DEPTH_UNITS_PER_METRE)
        png = cv2.imencode(".png", units)[1].tobytes()
        grey = rr.components.Colormap.Grayscale  # distinct from the colours of the motion states in the 3D view
        image = rr.EncodedDepthImage(blob=png, media_type="image/png", meter=_DEPTH_UNITS_PER_METRE, colormap=grey)
        self._stream.log("world/camera/image/depth", image)

    def _is_map_due(self, slam: V3DSLAM) -> bool:
        """Check whether the whole map was corrected, or has grown enough since it was logged."""
        is_corrected = slam.loop_closer.loop_count > self._loops
        return is_corrected or len(slam.map.keyframes) > _MAP_GROWTH * self._logged_keyframes

    def _log_map(self, slam: V3DSLAM) -> None:
        """Log the whole map and all poses after the latest correction."""
        self._log_part(slam, 0, slam.poses.trajectory().T_wc, "")
        if slam.occupancy is not None:
            log_voxels(self._stream, slam.occupancy.map)
        self._logged_keyframes, self._logged_frames = len(slam.map.keyframes), len(slam.poses)
        self._log_recent(slam)

    def _log_recent(self, slam: V3DSLAM) -> None:
        """Log the part of map and poses that is newer than the logged map."""
        frames = range(self._logged_frames - 1, len(slam.poses))  # the line begins at the last logged pose
        self._log_part(slam, self._logged_keyframes, invert(slam.poses.poses_of(frames)), "/recent")

    def _log_part(self, slam: V3DSLAM, first: int, T_wc: Tensor, entity: str) -> None:
        """Log the keyframes from an index on, their landmarks, and poses, shape (N, 4, 4)."""
        landmarks = slam.map.landmarks
        points = landmarks["point"][landmarks["active"] & (landmarks["keyframe"] >= first)].numpy()
        grey = rr.Points3D(points, colors=[rgba("tab:gray")], radii=rr.Radius.ui_points(1.5))
        self._stream.log(f"world/map/landmarks{entity}", grey)
        keyframes = [keyframe for keyframe in slam.map.active_keyframes if keyframe.index >= first]
        frustums = _frustums(self._camera, invert(stack_poses(keyframes)))
        self._stream.log(f"world/map/keyframes{entity}", _lines(frustums, "tab:cyan", width=0.7))
        positions = T_wc[:, :3, 3].numpy()
        self._stream.log(f"world/trajectory{entity}", _lines([positions], "tab:blue"))
        self._newest = list(positions[-1:])

    def _log_groundtruth(self, stamp: float, T_ec: Tensor, status: TrackingStatus | None) -> None:
        """Log the ground truth, once, aligned at the first pose that is not lost and has a true one."""
        if self._unaligned is None or status is TrackingStatus.LOST:
            return
        truth = self._unaligned
        matches = associate_trajectories(truth, Trajectory(torch.tensor([stamp], dtype=torch.float64), T_ec[None]))
        if not len(matches):
            return
        T_eg = T_ec @ invert(truth.T_wc[matches.groundtruth[0]])
        positions = transform_points(T_eg, truth.T_wc[:, :3, 3]).numpy()
        self._stream.log("world/groundtruth", _lines([positions], "goldenrod"))
        self._unaligned = None

    def _log_text(self, frame: RGBDFrame, objects: FrameObjects, slam: V3DSLAM) -> None:
        status = slam.poses.status or TrackingStatus.LOST
        heading = f"**frame {frame.index}** at {frame.stamp:.3f} s: {status.value}"
        summary = rr.TextDocument(f"{heading}\n\n{format_objects(objects)}", media_type="text/markdown")
        self._stream.log("frame_summary", summary)
        events = [status.value] if status is not TrackingStatus.TRACKED else []
        if slam.map.newest_keyframe_at(frame.stamp) is not None:
            events.append(f"keyframe {len(slam.map.keyframes) - 1}")
        if slam.loop_closer.loop_count > self._loops:
            self._loops = slam.loop_closer.loop_count
            events.append("loop closed, map corrected")
        if events:
            level = rr.TextLogLevel.WARN if status is TrackingStatus.LOST else rr.TextLogLevel.INFO
            self._stream.log("log", rr.TextLog("; ".join(events), level=level))


def _lines(strips: list[NDArray[np.float64]], colour: str, width: float = 1.5) -> rr.LineStrips3D:
    """Return lines through points, shape (N, 3) each, without those of fewer than two points."""
    lines = [strip for strip in strips if len(strip) > 1]
    return rr.LineStrips3D(lines, colors=[rgba(colour)], radii=rr.Radius.ui_points(width))


def _frustums(camera: PinholeCamera, T_wc: Tensor) -> list[NDArray[np.float64]]:
    """Return the frustum of each camera as one line, shape (10, 3): the image border and the edges to the centre."""
    width, height = camera.width - 1.0, camera.height - 1.0
    corners = torch.tensor([[0, 0], [width, 0], [width, height], [0, height]], dtype=torch.float64)
    points = torch.zeros(5, 3, dtype=torch.float64)  # the last is the camera centre
    points[:4, :2] = (corners - camera.K[:2, 2]) / camera.K.diagonal()[:2] * FRUSTUM_DEPTH
    points[:4, 2] = FRUSTUM_DEPTH
    line = points[[0, 1, 2, 3, 0, 4, 1, 2, 4, 3]]
    return list(transform_points(T_wc, line).numpy())
