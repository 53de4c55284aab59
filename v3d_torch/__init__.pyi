from .config import Config
from .config.loading import load_config
from .datasets import SourceOptions, load_sequence, open_source
from .datasets.realtime_playback import RealtimePlayback
from .datasets.tum_trajectory import read_trajectory, write_trajectory
from .errors import ConfigError, DownloadError, GroundTruthWarning, InputError, V3DError
from .frame_result import FrameResult
from .geometry.camera import BackProjector, PinholeCamera, back_project
from .geometry.depth_smoother import DepthSmoother, smooth_depth
from .geometry.normals import surface_normals
from .geometry.voxel import VoxelPool, Voxels, voxel_pool
from .live import LiveResult, LiveSLAM
from .mapping.map_io import StoredMap, load_map, save_map
from .mapping.static_views import StaticViews
from .objects.assignment import match_instances
from .objects.chamfer import ChamferDistance, chamfer_distance
from .objects.dbscan import DBSCAN, dbscan
from .objects.frame_objects import MotionState, TrackedObject
from .objects.instance_tracker import InstanceTracker
from .objects.intra_object_motion import Deformation, IntraObjectMotion, intra_object_motion
from .objects.largest_clusters import LargestClusters, largest_clusters
from .objects.voting import HoughVoting, Votes, hough_vote
from .reconstruction.mesh import Mesh, fuse_mesh
from .reconstruction.point_map import PointMap, fuse_points
from .runs.state import load_state, save_state
from .slam import V3DSLAM
from .tracking.camera_state import CameraState
from .types import Instances, RGBDFrame, TrackingStatus, Trajectory

__all__ = [
    "DBSCAN",
    "V3DSLAM",
    "BackProjector",
    "CameraState",
    "ChamferDistance",
    "Config",
    "ConfigError",
    "Deformation",
    "DepthSmoother",
    "DownloadError",
    "FrameResult",
    "GroundTruthWarning",
    "HoughVoting",
    "InputError",
    "InstanceTracker",
    "Instances",
    "IntraObjectMotion",
    "LargestClusters",
    "LiveResult",
    "LiveSLAM",
    "Mesh",
    "MotionState",
    "PinholeCamera",
    "PointMap",
    "RGBDFrame",
    "RealtimePlayback",
    "SourceOptions",
    "StaticViews",
    "StoredMap",
    "TrackedObject",
    "TrackingStatus",
    "Trajectory",
    "V3DError",
    "Votes",
    "VoxelPool",
    "Voxels",
    "back_project",
    "chamfer_distance",
    "dbscan",
    "fuse_mesh",
    "fuse_points",
    "hough_vote",
    "intra_object_motion",
    "largest_clusters",
    "load_config",
    "load_map",
    "load_sequence",
    "load_state",
    "match_instances",
    "open_source",
    "read_trajectory",
    "save_map",
    "save_state",
    "smooth_depth",
    "surface_normals",
    "voxel_pool",
    "write_trajectory",
]
