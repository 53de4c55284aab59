from .camera import BackProjector, PinholeCamera, back_project
from .config import Config
from .config_file import load_config
from .datasets import SourceOptions, load_sequence, open_source
from .depth import DepthSmoother, smooth_depth
from .errors import ConfigError, DownloadError, GroundTruthWarning, InputError, V3DError
from .mapping.dense import PointMap, fuse_points
from .mapping.mesh import Mesh, fuse_mesh
from .mapping.normals import surface_normals
from .mapping.recorder import Status
from .mapping.storage import StoredMap, load_map, save_map
from .mapping.views import StaticViews
from .objects.assignment import match_instances
from .objects.chamfer import ChamferDistance, chamfer_distance
from .objects.clusters import LargestClusters, largest_clusters
from .objects.dbscan import DBSCAN, dbscan
from .objects.dynamics import Judged, Verdict
from .objects.intra_motion import Deformation, IntraObjectMotion, intra_object_motion
from .objects.tracker import InstanceTracker
from .objects.voting import HoughVoting, Votes, hough_vote
from .objects.voxel import VoxelPool, Voxels, voxel_pool
from .percept import Tracked
from .slam import V3DSLAM
from .state import load_state, save_state
from .trajectory import read_trajectory, write_trajectory
from .types import Instances, RGBDFrame, Trajectory

__all__ = [
    "DBSCAN",
    "V3DSLAM",
    "BackProjector",
    "ChamferDistance",
    "Config",
    "ConfigError",
    "Deformation",
    "DepthSmoother",
    "DownloadError",
    "GroundTruthWarning",
    "HoughVoting",
    "InputError",
    "InstanceTracker",
    "Instances",
    "IntraObjectMotion",
    "Judged",
    "LargestClusters",
    "Mesh",
    "PinholeCamera",
    "PointMap",
    "RGBDFrame",
    "SourceOptions",
    "StaticViews",
    "Status",
    "StoredMap",
    "Tracked",
    "Trajectory",
    "V3DError",
    "Verdict",
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
