"""Shows a run in rerun: camera, verdicts, votes, map, trajectory, numbers."""

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
from v3d_torch.evaluation.pose_association import match
from v3d_torch.evaluation.report import is_oriented
from v3d_torch.geometry.camera import PinholeCamera
from v3d_torch.geometry.se3 import invert
from v3d_torch.mapping.keyframe import Keyframe, stack_poses
from v3d_torch.objects.motion_classifier import FrameObjects
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import RGBDFrame, TrackingStatus, Trajectory
from v3d_torch.viz.rerun.layout import layout
from v3d_torch.viz.rerun.scene import in_words, log_scene, rgba, verdict_classes

_LOG = logging.getLogger("v3d_torch")
_PATIENCE = 30.0  # seconds for what is still on its way to the viewer when the run ends
_JPEG_QUALITY = 80
_PER_METRE = 1000  # units of the depth as recorded
_FRUSTUM = 0.08  # metres from a keyframe to the image plane that is drawn


class RerunViewer:
    """Logs every frame on the timelines ``frame`` (its index) and ``stamp`` (its time).

    ========================================  ==========================================================================
    ``world/camera``                          pose of the frame, T_wc
    ``world/camera/image``                    pinhole; below it ``rgb``, ``depth``, ``masks`` and boxes of ``objects``
    ``world/objects``, ``world/centroids``    clouds and centroids of the objects; their class is the verdict
    ``world/votes``                           lines between who voted for what is dynamic; others: ``without_effect``
    ``world/map``                             ``landmarks`` and ``keyframes``, all again after each new keyframe
    ``world/trajectory``                      all poses, again after each new keyframe; ``newest``: those since
    ``world/groundtruth``                     true way of the camera, aligned at the first pose that has a true one
    ``parse_timestamp``, ``votes``, ``chamfer``       curves, by stage and by id of the object
    ``verdicts``, ``log``                     the frame in words
    ========================================  ==========================================================================

    What is adjusted for a keyframe, and a loop that ends there, is taken in with the frame after it: then all is logged
    again. The lens' distortion is not shown: the image is as the camera delivers it.

    Args:
        stream: recording, from `open_stream`.
        camera: of all frames.
        groundtruth: true poses, or None; those whose orientations were not measured cannot be laid on the estimate.
        name: of the sequence.
    """

    def __init__(
        self, stream: rr.RecordingStream, camera: PinholeCamera, groundtruth: Trajectory | None, name: str
    ) -> None:
        self._stream = stream
        self._camera = camera
        self._unaligned = groundtruth if groundtruth is not None and is_oriented(groundtruth) else None
        self._newest: list[NDArray[np.float64]] = []  # positions since the map was logged, and the last before
        self._unsettled: Keyframe | None = None  # keyframe that the map was not adjusted to yet
        self._loops = 0
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.send_recording_name(name)
        truth = "ground truth aligned at the first pose" if self._unaligned is not None else "no ground truth"
        stream.send_blueprint(layout(f"World ({truth})"))
        stream.log("world", rr.ViewCoordinates.RDF, verdict_classes(), static=True)
        size = [camera.width, camera.height]
        pinhole = rr.Pinhole(image_from_camera=camera.K.numpy(), resolution=size, image_plane_distance=0.3)
        stream.log("world/camera/image", pinhole, static=True)

    def show(self, frame: RGBDFrame, scene: FrameObjects, slam: V3DSLAM, seconds: Mapping[str, float]) -> None:
        """Log a frame; the time that takes is that of the stage ``viewer``."""
        with slam.timer("viewer"):
            self._stream.set_time("frame", sequence=frame.index)
            self._stream.set_time("stamp", timestamp=frame.stamp)
            keyframes = slam.mapper.map.keyframes
            kept = bool(keyframes) and keyframes[-1].frame == frame.index
            T_wc = invert(slam.poses.T_cw)
            self._show_camera(frame, T_wc)
            log_scene(self._stream, scene)
            if self._unsettled is not None:
                self._show_map(slam)
            else:
                self._newest.append(T_wc[:3, 3].numpy())
            self._unsettled = slam.back_end.keyframe
            self._stream.log("world/trajectory/newest", _way([np.array(self._newest)], "tab:blue"))
            self._align(frame.stamp, T_wc, slam.poses.status)
            for stage, elapsed in seconds.items():
                self._stream.log(f"seconds/{stage}", rr.Scalars(elapsed))
            self._say(frame, scene, slam, kept)

    def finish(self, slam: V3DSLAM) -> None:
        """Log map and poses as they came out, and close file and connection.

        Raises:
            OutputError: the file could not be written to the end.
        """
        self._show_map(slam)
        try:
            self._stream.flush(timeout_sec=_PATIENCE)
        except RuntimeError as error:
            if "gRPC" not in str(error):
                reason = f"the recording for rerun is not complete ({error}); free the disk or choose another file"
                raise OutputError(reason) from error
            _LOG.warning("the viewer was closed: %s", error)  # which is no failure of the run
        finally:
            self._stream.disconnect()

    def _show_camera(self, frame: RGBDFrame, T_wc: Tensor) -> None:
        pose = rr.Transform3D(translation=T_wc[:3, 3].numpy(), mat3x3=T_wc[:3, :3].numpy())
        self._stream.log("world/camera", pose)
        bgr = np.ascontiguousarray(frame.image.permute(1, 2, 0).numpy()[..., ::-1])
        jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        self._stream.log("world/camera/image/rgb", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        depth = (frame.depth[0] * _PER_METRE).round().clamp(max=np.iinfo(np.uint16).max).numpy().astype(np.uint16)
        png = cv2.imencode(".png", depth)[1].tobytes()
        grey = rr.components.Colormap.Grayscale  # in the world, where it lies beside the colours of verdicts
        image = rr.EncodedDepthImage(blob=png, media_type="image/png", meter=_PER_METRE, colormap=grey)
        self._stream.log("world/camera/image/depth", image)

    def _show_map(self, slam: V3DSLAM) -> None:
        """Log all of the map and all poses as they are after the newest correction."""
        landmarks = slam.mapper.map.landmarks
        points = landmarks["point"][landmarks["active"]].numpy()
        grey = rr.Points3D(points, colors=[rgba("tab:gray")], radii=rr.Radius.ui_points(1.5))
        self._stream.log("world/map/landmarks", grey)
        frusta = _frusta(self._camera, invert(stack_poses(slam.mapper.map.active_keyframes)))
        self._stream.log("world/map/keyframes", _way(frusta, "tab:cyan", width=0.7))
        positions = slam.poses.trajectory().T_wc[:, :3, 3].numpy()
        self._stream.log("world/trajectory", _way([positions], "tab:blue"))
        self._newest = list(positions[-1:])

    def _align(self, stamp: float, T_ec: Tensor, status: TrackingStatus | None) -> None:
        """Log the ground truth as soon as a pose says where it lies in the estimate's world."""
        if self._unaligned is None or status is TrackingStatus.LOST:
            return
        truth = self._unaligned
        matches = match(truth, Trajectory(torch.tensor([stamp], dtype=torch.float64), T_ec[None]))
        if not len(matches):
            return
        T_eg = T_ec @ invert(truth.T_wc[matches.groundtruth[0]])
        positions = (truth.T_wc[:, :3, 3] @ T_eg[:3, :3].mT + T_eg[:3, 3]).numpy()
        self._stream.log("world/groundtruth", _way([positions], "goldenrod"))
        self._unaligned = None

    def _say(self, frame: RGBDFrame, scene: FrameObjects, slam: V3DSLAM, kept: bool) -> None:
        status = slam.poses.statuses[-1]
        head = f"**frame {frame.index}** at {frame.stamp:.3f} s: {status.value}"
        self._stream.log("verdicts", rr.TextDocument(f"{head}\n\n{in_words(scene)}", media_type="text/markdown"))
        events = [status.value] if status is not TrackingStatus.TRACKED else []
        events += [f"keyframe {len(slam.mapper.map.keyframes) - 1}"] if kept else []
        if slam.loop_closer.loop_count > self._loops:
            self._loops = slam.loop_closer.loop_count
            events.append("loop closed, map corrected")
        if events:
            level = rr.TextLogLevel.WARN if status is TrackingStatus.LOST else rr.TextLogLevel.INFO
            self._stream.log("log", rr.TextLog("; ".join(events), level=level))


def _way(strips: list[NDArray[np.float64]], colour: str, width: float = 1.5) -> rr.LineStrips3D:
    """Lines through points, shape (N, 3) each; a line needs two."""
    lines = [strip for strip in strips if len(strip) > 1]
    return rr.LineStrips3D(lines, colors=[rgba(colour)], radii=rr.Radius.ui_points(width))


def _frusta(camera: PinholeCamera, T_wc: Tensor) -> list[NDArray[np.float64]]:
    """Each camera's field of view as one line, shape (10, 3): the image's border and the edges to the centre."""
    width, height = camera.width - 1.0, camera.height - 1.0
    corners = torch.tensor([[0, 0], [width, 0], [width, height], [0, height]], dtype=torch.float64)
    points = torch.zeros(5, 3, dtype=torch.float64)  # the last is the centre of projection
    points[:4, :2] = (corners - camera.K[:2, 2]) / camera.K.diagonal()[:2] * _FRUSTUM
    points[:4, 2] = _FRUSTUM
    line = points[[0, 1, 2, 3, 0, 4, 1, 2, 4, 3]]
    return list((line @ T_wc[:, :3, :3].mT + T_wc[:, None, :3, 3]).numpy())
