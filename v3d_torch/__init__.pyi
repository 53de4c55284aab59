from .backend.pose_graph import PoseGraphOptimiser, PoseGraphResult, optimise_pose_graph
from .config import Config
from .config.loading import load_config
from .datasets import SourceOptions, load_sequence, open_source
from .datasets.frame_datasets import ClipDataset, FrameDataset, PairDataset
from .datasets.realtime_playback import RealtimePlayback
from .datasets.tum_trajectory import read_trajectory, write_trajectory
from .errors import ConfigError, DownloadError, GroundTruthWarning, InputError, V3DError
from .evaluation.ate import ate
from .evaluation.rpe import RelativePoseError, rpe
from .evaluation.umeyama import umeyama
from .features.essential import EssentialMatrix, EssentialRANSAC, essential_ransac
from .features.matching import DescriptorMatcher, match_descriptors
from .features.pnp_ransac import PnP, PnPRANSAC, pnp_ransac
from .frame_result import FrameResult
from .geometry.camera import BackProjector, PinholeCamera, back_project
from .geometry.depth_smoother import DepthSmoother, smooth_depth
from .geometry.normals import surface_normals
from .geometry.se3 import se3_exp, se3_log
from .geometry.voxel import VoxelPool, Voxels, voxel_pool
from .live import LiveResult, LiveSLAM
from .mapping.bundle_adjustment import BundleAdjuster, BundleAdjustment, bundle_adjust
from .mapping.map_io import StoredMap, load_map, save_map
from .mapping.readout_calibration import ReadoutEstimator, estimate_readout
from .mapping.static_views import StaticViews
from .objects.assignment import match_instances
from .objects.chamfer import ChamferDistance, chamfer_distance
from .objects.dbscan import DBSCAN, dbscan
from .objects.frame_objects import MotionState, TrackedObject
from .objects.instance_tracker import InstanceTracker
from .objects.intra_object_motion import Deformation, IntraObjectMotion, intra_object_motion
from .objects.largest_clusters import LargestClusters, largest_clusters
from .objects.voting import HoughVoting, Votes, hough_vote
from .occupancy.floor import Floor, find_floor
from .occupancy.map_server import write_map_server_files
from .occupancy.occupancy_grid import OccupancyGrid, occupancy_grid
from .occupancy.occupancy_io import StoredOccupancy, load_occupancy, save_occupancy
from .occupancy.occupancy_map import OccupancyMap, VoxelState
from .occupancy.occupancy_mapper import OccupancyMapper
from .occupancy.octomap_file import write_octomap
from .occupancy.up_direction import UpDirection, estimate_up
from .odometry.dense_aligner import DenseAligner, DenseAlignment, align_depth
from .odometry.rolling_shutter import RollingShutterCompensation, compensate_rolling_shutter
from .optim.pose_refinement import PoseRefinement, PoseRefiner, refine_pose
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
    "BundleAdjuster",
    "BundleAdjustment",
    "CameraState",
    "ChamferDistance",
    "ClipDataset",
    "Config",
    "ConfigError",
    "Deformation",
    "DenseAligner",
    "DenseAlignment",
    "DepthSmoother",
    "DescriptorMatcher",
    "DownloadError",
    "EssentialMatrix",
    "EssentialRANSAC",
    "Floor",
    "FrameDataset",
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
    "OccupancyGrid",
    "OccupancyMap",
    "OccupancyMapper",
    "PairDataset",
    "PinholeCamera",
    "PnP",
    "PnPRANSAC",
    "PointMap",
    "PoseGraphOptimiser",
    "PoseGraphResult",
    "PoseRefinement",
    "PoseRefiner",
    "RGBDFrame",
    "ReadoutEstimator",
    "RealtimePlayback",
    "RelativePoseError",
    "RollingShutterCompensation",
    "SourceOptions",
    "StaticViews",
    "StoredMap",
    "StoredOccupancy",
    "TrackedObject",
    "TrackingStatus",
    "Trajectory",
    "UpDirection",
    "V3DError",
    "Votes",
    "VoxelPool",
    "VoxelState",
    "Voxels",
    "align_depth",
    "ate",
    "back_project",
    "bundle_adjust",
    "chamfer_distance",
    "compensate_rolling_shutter",
    "dbscan",
    "essential_ransac",
    "estimate_readout",
    "estimate_up",
    "find_floor",
    "fuse_mesh",
    "fuse_points",
    "hough_vote",
    "intra_object_motion",
    "largest_clusters",
    "load_config",
    "load_map",
    "load_occupancy",
    "load_sequence",
    "load_state",
    "match_descriptors",
    "match_instances",
    "occupancy_grid",
    "open_source",
    "optimise_pose_graph",
    "pnp_ransac",
    "read_trajectory",
    "refine_pose",
    "rpe",
    "save_map",
    "save_occupancy",
    "save_state",
    "se3_exp",
    "se3_log",
    "smooth_depth",
    "surface_normals",
    "umeyama",
    "voxel_pool",
    "write_map_server_files",
    "write_octomap",
    "write_trajectory",
]
