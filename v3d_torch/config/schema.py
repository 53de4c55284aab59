"""Typed configuration: one section per stage, each value with its unit and its reason.

`v3d_torch.config.loading` reads it from YAML files and the command line; each run writes the resolved configuration
to the folder of its results. Values that only an expert of one file would change are named constants of that file.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator


class Section(BaseModel):
    """A part of the configuration: immutable, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SegmentationConfig(Section):
    """Instance segmentation (paper, Sec. III-A)."""

    source: Literal["yolo", "masks", "none"] = "yolo"
    """Source of instances: the network, a folder of id images, or none (the baseline without masks)."""
    model: Literal["yolov8n-seg", "yolo11n-seg", "yolo26n-seg"] = "yolov8n-seg"
    """Network. The paper names YOLOv8; its nano model is small enough for a CPU that also tracks the camera."""
    height: int = Field(320, gt=0, multiple_of=32)
    """Rows of the network input, pixels. Scaling a 640x480 image by two thirds halves the time; a person at 6 m is
    still about 100 pixels high, and the outlines are refined from the depth."""
    width: int = Field(416, gt=0, multiple_of=32)
    """Columns of the network input, pixels."""
    precision: Literal["int8", "float32"] = "int8"
    """Number format of the convolutions. 8-bit integers halve the time on processors with instructions for them; on
    other processors float32 is used."""
    score_threshold: float = Field(0.25, ge=0, le=1)
    """Minimum class score; 0.25 is the default of YOLOv8's authors. A missed person costs more than a false one."""
    iou_threshold: float = Field(0.7, ge=0, le=1)
    """Boxes of one class with a larger intersection over union are the same instance (non-maximum suppression;
    YOLOv8)."""
    duplicate_overlap: float = Field(0.7, gt=0, le=1)
    """An instance is a duplicate if a larger fraction of it lies within an instance of the same class with a higher
    score, or if its mask and that of an instance of another class coincide to this fraction."""
    upright: bool = True
    """True to rotate the images of a rolled camera upright before segmentation (false in the paper)."""
    max_instances: int = Field(32, gt=0)
    """Maximum number of instances in an image; people and animals are kept first, then the highest scores. It bounds
    memory and is far above the number of objects in a room."""
    interval: int = Field(1, gt=0)
    """Every n-th frame of a sequence is segmented. In the frames between, masks are moved with the objects and refined
    from the depth."""
    threads: int = Field(1, gt=0, le=256)
    """Threads of the inference engine. On two cores a second thread would take time from tracking."""


class DepthConfig(Section):
    """Depth re-estimation (paper, Sec. III-B.1)."""

    kernel_size: Literal[1, 3, 5, 7, 9, 11, 13, 15] = 5
    """Side of the Gaussian window, pixels (authors' code)."""
    sigma: float = Field(1.0, gt=0)
    """Standard deviation of the Gaussian, pixels (authors' code)."""
    edge_ratio: float = Field(0.05, gt=0)
    """Depth is averaged along rows, then along columns. A neighbour whose depth differs by a larger ratio lies behind
    an edge and is not averaged."""


class CloudConfig(Section):
    """Instance clouds and their outlier rejection (paper, Sec. III-B.2)."""

    stride: int = Field(4, gt=0, le=100)
    """Every n-th row and column of a mask becomes points, which is finer than the network's masks: their cells have 6
    pixels by default. Up to 4 m the points of a Kinect are then at most 0.03 m apart, well within the radius of DBSCAN.
    It is scaled to the size of the images, and to a shorter focal length."""
    max_depth: float = Field(6.0, gt=0)
    """Maximum depth of points, metres: two standard deviations of the depth of a Kinect are 0.1 m there, as large as
    the motion to detect."""
    voxel_size: float = Field(0.02, ge=0.001, allow_inf_nan=False)
    """Side of a voxel, metres (authors' code)."""
    eps: float = Field(0.08, gt=0)
    """Radius of DBSCAN, metres: four voxels bridge the depth steps of a Kinect at 4 m, but not a person and the wall
    behind."""
    min_samples: int = Field(5, gt=0)
    """Minimum number of points within the radius of a DBSCAN core point, itself included."""
    min_points: int = Field(30, gt=0)
    """Minimum number of voxels of an object: the centroid of a smaller cluster is noise."""


class TrackerConfig(Section):
    """Ids of objects over time, and prediction of objects that the network misses (paper, Sec. II and III)."""

    max_speed: float = Field(3.0, gt=0)
    """Maximum speed of an object, m/s: a person who runs. Matches beyond it are rejected."""
    max_jump: float = Field(0.5, gt=0)
    """Maximum jump of a centroid, metres, in addition to its motion: the centroid also jumps when an object is cut off
    by the image border or occluded."""
    acceleration_noise: float = Field(1.2, gt=0, allow_inf_nan=False)
    """Square root of the spectral density of the acceleration, m/s^1.5, which is the standard deviation of the change
    of velocity in one second: a person can stop or turn within a second."""
    min_overlap: float = Field(0.4, ge=0, le=1)
    """Minimum mask overlap to continue an object with an instance of another class: the class of an object can flicker
    between frames, but a cup does not turn into the table below it."""
    max_missed_time: float = Field(0.5, ge=0)
    """Time for which an object that the network misses is predicted, seconds: about one step of a person. 0 in the
    ablation."""
    max_lost_time: float = Field(5.0, ge=0)
    """Time after `max_missed_time` in which an object that reappears keeps its id, seconds: people walk behind others,
    or leave the view of a camera that turns. Appearance and position have to match."""
    compare_appearance: bool = True
    """Compare the colours of instances with those of objects. False in the ablation."""


class VotingConfig(Section):
    """Spatially reasoned Hough voting (paper, Sec. III-C, Alg. 1)."""

    enabled: bool = True
    """False in the ablation."""
    distance_threshold: float = Field(0.05, gt=0)
    """T_d, metres: a larger change of the distance between two centroids is a vote for both objects."""
    vote_threshold: int = Field(2, gt=0)
    """T_v, number of votes from which an object is dynamic (authors' code: more than one)."""
    time_spans: tuple[Annotated[float, Field(ge=0, le=1)], ...] = (0.0, 0.3, 0.9)
    """Times over which changes of distances are measured, seconds; 0 is the previous frame (the paper's rule). At 1 m/s
    a person moves 3 cm between frames at 30 Hz, which is within the noise of a centroid, and 30 cm in 0.3 s. Detections
    are stored for 1 s."""


class FreeSpaceConfig(Section):
    """Free-space check: objects have moved if their former places are free, or if their present places were free.

    It confirms the votes, which can be wrong: centroids and clouds also change when an object is cut off by the image
    border, occluded or segmented differently, and two walking persons alone give every chair two votes.
    """

    enabled: bool = True
    """False for the paper's rules."""
    time_spans: tuple[Annotated[float, Field(ge=0, le=10)], ...] = (0.3, 0.9)
    """Times between the depth images that are compared, seconds: a walking person moves 0.3 m in the first, a slow one
    in the second. Depth images are stored for the longest one."""
    min_unlabelled_area: float = Field(0.02, gt=0)
    """Minimum area of an unlabelled moving region, square metres: a hand with its forearm. Infinite in the ablation."""
    max_depth: float = Field(6.0, gt=0)
    """Maximum depth of points that are checked, metres: beyond, two standard deviations of the depth are as large as
    the motion to detect."""
    inverse_depth_tolerance: float = Field(0.01, gt=0)
    """Tolerance of the inverse depth, 1/m: seven standard deviations of that of a structured-light camera. The
    tolerance of depth increases with its square."""
    min_tolerance: float = Field(0.04, ge=0.001)
    """Minimum depth tolerance, metres: the thickness of clothes and of a voxel."""
    depth_sync_error: float = Field(0.015, ge=0, le=1)
    """Maximum time between the stamp of a depth image and the exposure of a pixel, seconds: about half of the interval
    between two frames at 30 Hz, within which an image is read. If the camera turns, depth is shifted by the pixels that
    it turns in this time."""
    min_depth: float = Field(0.3, gt=0)
    """Minimum depth of points that are checked, metres: below the range of the cameras."""
    min_points: int = Field(30, gt=0)
    """Minimum number of visible points for a decision."""


class FeatureShiftConfig(Section):
    """Shift of the features on an object against the camera motion.

    It shows slow motions of textured things before free space does: a screen that is moved sideways uncovers half of
    its place only after half of its width.
    """

    enabled: bool = True
    """False for the paper's rules."""
    time_span: float = Field(0.3, gt=0, le=1)
    """Time over which shifts are added up, seconds, the shorter one of the free-space check: within it, something that
    is pushed hardly changes its direction."""


class ChamferConfig(Section):
    """Intra-object motion by Chamfer distance (paper, Sec. III-D)."""

    enabled: bool = True
    """False in the ablation."""
    distance_threshold: float = Field(0.025, gt=0)
    """Root-mean-square nearest-neighbour distance above which an object deforms, metres: sqrt(D / 2), where D is the
    paper's sum of two mean squares. Two samplings of a rigid surface by 2 cm voxels differ by 1 cm, and the noise of a
    Kinect at 3 m adds as much."""
    time_span: float = Field(0.3, ge=0, le=1)
    """Time between the two clouds that are compared, seconds; 0 is the previous frame (the paper's rule). Detections
    are stored for 1 s."""
    keep_deforming_features: bool = False
    """True to track features on deforming objects. The paper's text describes both; its code masks them."""


class StaticMaskConfig(Section):
    """Mask of the static pixels, on which the camera is tracked.

    Dilations and margins are those for images of 640 columns, and are scaled to the size of the images.
    """

    confirm_static_time: float = Field(1.0, ge=0)
    """Time after the first detection for which a person or animal is masked, unless observed at rest, seconds (the
    paper masks persons until they are classified). Without usable depth, they stay masked."""
    hold_dynamic_time: float = Field(1.0, ge=0)
    """Time for which an object stays dynamic or deforming after the last evidence, seconds: a walking person pauses
    between steps. A rigid object becomes static as soon as it is observed at rest; if its features have shifted, it
    stays dynamic until then."""
    confirm_dynamic_frames: int = Field(2, gt=0, le=100)
    """Number of frames with evidence within this time before a dynamic state is held: evidence in a single frame can be
    depth noise."""
    dilation: int = Field(1, ge=0, le=100)
    """Dilation of masks regardless of depth, pixels: the alignment error of colour and depth. One more pixel takes
    a large part of the static pixels in a dense crowd."""
    map_dilation: int = Field(4, ge=0, le=100)
    """Dilation of the masks of moving objects and people for the map, pixels: depth is wrong at their edges, and the
    map can take the pixels beside them from another frame."""
    depth_margin: int = Field(8, ge=0, le=100)
    """Dilation of masks over pixels with the depth of the object or without depth, pixels: a little more than a cell of
    the network's masks, which has 6 pixels by default."""
    surface_margin: int = Field(32, ge=0, le=1000)
    """Dilation of masks along a continuous surface, pixels: a hand at 3 m. Larger values also mask more of a table that
    a person touches. 0 turns it off."""
    edge_ratio: float = Field(0.04, gt=0)
    """Relative depth difference over four pixels that is an edge: a surface viewed at 76 degrees differs by 0.03, at a
    focal length of 525 pixels."""
    min_surface_fraction: float = Field(0.4, ge=0, le=1)
    """Minimum fraction of a continuous surface that the object covers for its mask to grow along that surface; a foot
    covers little of a floor."""
    depth_tolerance: float = Field(0.05, gt=0)
    """Maximum depth difference between a pixel and the points of the object around it, metres, in addition to the depth
    noise."""


class ObjectsConfig(Section):
    """The object stage: clouds, tracks, motion states."""

    clouds: CloudConfig = CloudConfig()
    tracker: TrackerConfig = TrackerConfig()
    voting: VotingConfig = VotingConfig()
    free_space: FreeSpaceConfig = FreeSpaceConfig()
    feature_shift: FeatureShiftConfig = FeatureShiftConfig()
    chamfer: ChamferConfig = ChamferConfig()
    static_mask: StaticMaskConfig = StaticMaskConfig()


class FeaturesConfig(Section):
    """ORB features (paper, Sec. III-A and III-E)."""

    count: int = Field(1500, gt=0)
    """Number of features per frame. More than the 1000 of ORB-SLAM2, because masks remove some of them."""
    levels: int = Field(8, gt=0, le=20)
    """Levels of the scale pyramid (ORB-SLAM2). The finest has at most 1000 columns, also in images that have more."""
    scale: float = Field(1.2, gt=1)
    """Scale factor between levels (ORB-SLAM2)."""
    cell: int = Field(32, gt=0)
    """Side of the grid cells over which selected features are spread, pixels."""
    max_depth: float = Field(8.0, gt=0)
    """Maximum depth of features, metres: the standard deviation of the depth of a Kinect is 0.09 m there. Beyond it a
    feature has no depth."""


class OdometryConfig(Section):
    """Camera motion between two frames from features (paper, Sec. III-E)."""

    max_features: int = Field(500, gt=0)
    """Maximum number of features of a frame, spread over the image, that are matched with all features of the next one.
    More take longer and do not improve the pose, which is refined in the map. Relocalisation matches all features."""
    max_ratio: float = Field(0.8, gt=0, le=1)
    """Lowe's ratio between the best and the second Hamming distance."""
    max_hamming: int = Field(64, gt=0, le=256)
    """Maximum Hamming distance of a match, bits of 256."""
    iterations: int = Field(300, gt=0)
    """Maximum number of RANSAC hypotheses: with a probability of 0.9999 one is a sample of 8 pairs without outliers,
    for the fundamental matrix, at 35 % outliers. P3P samples fewer pairs and needs fewer hypotheses."""
    min_inliers: int = Field(20, gt=0)
    """Minimum number of inliers: a dozen wrong matches can agree by chance."""
    max_speed: float = Field(5.0, gt=0)
    """Maximum speed of the camera, m/s; faster motions are rejected."""


class DenseOdometryConfig(Section):
    """Camera motion between two frames from all pixels, used when features fail."""

    halvings: tuple[Annotated[int, Field(ge=0, le=12)], ...] = (4, 2, 1)
    """Number of times that the image is halved for each pyramid level, coarse to fine. A shift of 60 pixels between
    frames is about 4 pixels at the coarsest level."""
    iterations: int = Field(10, gt=0)
    """Maximum number of Levenberg-Marquardt steps at a level."""
    max_depth: float = Field(8.0, gt=0)
    """Maximum depth, metres, as for features."""
    edge_ratio: float = Field(0.05, gt=0)
    """Neighbours with a larger relative depth difference lie on two surfaces, as in the depth re-estimation."""
    degrees_of_freedom: float = Field(5.0, gt=0)
    """Degrees of freedom of the t-distribution of the residuals (Kerl et al., ICRA 2013)."""
    inverse_depth_sigma: float = Field(0.003, gt=0)
    """Minimum standard deviation of inverse depth, 1/m: twice that of the sensor (Khoshelham and Elberink, Sensors
    2012)."""
    min_overlap: float = Field(0.3, gt=0, le=1)
    """Minimum fraction of the reference points that are visible in the current frame."""
    min_observability: float = Field(1e-3, gt=0, le=1)
    """Minimum ratio of the smallest to the largest eigenvalue of the information matrix, with translation measured in
    median depths. Below it, some motion is not observable, as in front of a wall without texture."""


class TrackingConfig(Section):
    """Tracking of frames against the local map."""

    max_hamming: int = Field(64, gt=0, le=256)
    """Maximum Hamming distance of a match, bits of 256."""
    max_ratio: float = Field(0.9, gt=0, le=1)
    """Lowe's ratio among the candidates within the search radius."""
    inverse_depth_sigma: float = Field(0.025, gt=0)
    """Standard deviation of inverse depth, 1/m; that of depth is this times the squared depth. A static plane gives
    0.0014 (Khoshelham and Elberink, Sensors 2012), but corners lie on depth edges, and colour and depth are neither
    simultaneous nor perfectly registered. It equals ORB-SLAM2's setting: a pixel of disparity at a baseline of 40 pixel
    metres."""
    pixel_sigma: float = Field(0.7, gt=0)
    """Standard deviation of the position of a feature at octave 0, pixels. In sharp images it is a third of a pixel;
    blur and changes of perspective add to it."""
    min_inliers: int = Field(20, gt=0)
    """Minimum number of landmarks found; with fewer the camera is lost."""
    local_keyframes: int = Field(15, gt=0)
    """Number of keyframes whose landmarks make up the local map."""


class RollingShutterConfig(Section):
    """Compensation of the times at which rows of colour and depth are read while the camera moves."""

    enabled: bool = True
    """False to treat all rows of both images as simultaneous: the rolling shutter and the depth delay are ignored."""
    readout: float = Field(0.02, ge=-0.05, le=0.05)
    """Initial value of the time from reading the first row to reading the last, seconds; it is then calibrated with the
    map. Not used if the camera file states the readout. The colour cameras of Kinect, Xtion, D415 and D435 have a
    rolling shutter of 0.02 to 0.03 s; that of the D455 is global."""
    readout_sigma: float = Field(0.015, gt=0)
    """Standard deviation of the initial readout, seconds: a global shutter and the slowest rolling shutter are both
    within two standard deviations."""


class MappingConfig(Section):
    """Keyframes and landmarks."""

    enabled: bool = True
    """False to localise the camera in a loaded map without changing the map."""
    max_keyframe_interval: int = Field(20, gt=0)
    """Maximum number of frames between keyframes."""
    min_tracked_ratio: float = Field(0.75, gt=0, le=1)
    """A frame becomes a keyframe if its number of tracked landmarks, divided by the highest number of a frame since the
    last keyframe, is lower (ORB-SLAM2 for RGB-D), and if it adds `tracking.min_inliers` landmarks."""
    min_tracked: int = Field(100, gt=0)
    """A frame becomes a keyframe if it tracks fewer landmarks, adds `tracking.min_inliers` landmarks, and is at least
    the fourth after the last keyframe. A frame with fewer static features with depth does not start a map: keep
    it well below `features.count`."""
    map_by_odometry_after: float = Field(0.5, ge=0)
    """Time since the camera was last tracked in the map after which keyframes are created with the pose of the
    odometry, seconds. Odometry drifts, and usually the camera is tracked in the map again earlier."""
    restart_after: float = Field(1.0, gt=0)
    """Time after which a lost camera that observes enough features starts a disconnected part of the map, seconds."""
    landmarks_per_keyframe: int = Field(1000, gt=0)
    """Maximum number of landmarks of a keyframe, old and new (ORB-SLAM2's number of features)."""
    fusion_keyframes: int = Field(10, ge=0)
    """Number of covisible keyframes in which the landmarks of a new keyframe are searched and fused (ORB-SLAM2 for
    RGB-D)."""
    redundant_ratio: float = Field(0.9, gt=0, le=1)
    """A keyframe is culled if a larger fraction of its landmarks is redundant, which means well observed by other
    keyframes (ORB-SLAM2). 1 culls none."""
    redundant_views: int = Field(3, gt=0)
    """Number of other keyframes that must observe a landmark for it to be redundant (ORB-SLAM2)."""
    bundle_keyframes: int = Field(15, ge=0)
    """Number of keyframes around the newest one whose poses are adjusted in a local bundle adjustment, and which are
    culled if they are redundant; the same as in the local map. 0 turns both off."""


class LoopConfig(Section):
    """Loop closing and pose graph (paper, Sec. III-E)."""

    enabled: bool = True
    """False in the ablation."""
    candidates: int = Field(3, gt=0)
    """Number of candidate keyframes that are verified."""
    min_keyframe_gap: int = Field(10, gt=0)
    """Minimum number of keyframes between the two ends of a loop, and between two loops."""
    min_inliers: int = Field(40, gt=0)
    """Minimum number of inliers of the geometric verification."""
    min_inlier_ratio: float = Field(0.15, ge=0, le=1)
    """Minimum fraction of the visible landmarks that are inliers: with fewer, the error of the pose exceeds the drift
    that it would correct. It does not apply to the relocalisation of a lost camera."""


class MeshConfig(Section):
    """Triangle mesh of the static scene."""

    enabled: bool = False
    """True to write a mesh."""
    voxel_size: float = Field(0.02, ge=0.005, allow_inf_nan=False)
    """Side of a voxel, metres: the pixels used lie 1.5 cm apart at 4 m, where the depth error is 2 cm."""
    truncation: float = Field(0.08, gt=0, allow_inf_nan=False)
    """Truncation distance of the signed distance function, metres: three times the combined error of poses and of
    depth at 4 m."""


class DenseMapConfig(Section):
    """Coloured point map and mesh of the static scene."""

    stride: int = Field(2, gt=0, le=100)
    """Every n-th row and column of a keyframe is used: points are 8 mm apart at 2 m, less than a voxel."""
    max_depth: float = Field(4.0, gt=0)
    """Maximum depth of points, metres; the noise of farther points would blur the map."""
    voxel_size: float = Field(0.01, ge=0.001, allow_inf_nan=False)
    """Side of a voxel, metres: nearly twice the standard deviation of the depth of a Kinect at 2 m."""
    mesh: MeshConfig = MeshConfig()


class OccupancyConfig(Section):
    """Occupancy map: free and occupied space for planning, grown with every frame (OctoMap, Hornung et al. 2013)."""

    enabled: bool = False
    """True to build an occupancy map and write it."""
    voxel_size: float = Field(0.05, ge=0.01, allow_inf_nan=False)
    """Side of a voxel, metres: OctoMap's and ROS's usual resolution in rooms, twice the depth error of a Kinect at
    4 m."""
    interval: int = Field(3, gt=0)
    """Every n-th frame is added: at 30 Hz the map is updated ten times per second, and a person walks 0.1 m between."""
    stride: int = Field(8, gt=0, le=100)
    """Every n-th row and column is added, with a different offset each time: rays are 0.06 m apart at 4 m, about a
    voxel."""
    max_depth: float = Field(4.0, gt=0, le=10)
    """Maximum depth of obstacles, metres, as for the dense map; farther rays show free space up to it."""
    inverse_depth_tolerance: float = Field(0.006, ge=0)
    """Tolerance of the inverse depth, 1/m: four standard deviations of that of a structured-light camera (Khoshelham
    and Elberink, Sensors 2012). Space within the tolerance of a surface is not observed as free."""
    hit_probability: float = Field(0.7, gt=0.5, lt=1)
    """Probability that a voxel that contains a depth measurement is occupied (OctoMap)."""
    miss_probability: float = Field(0.4, gt=0, lt=0.5)
    """Probability that a voxel that a ray passes through is occupied (OctoMap)."""
    min_probability: float = Field(0.12, gt=0, lt=0.5)
    """Lower limit of the probability of a voxel: free space can become occupied after a few hits (OctoMap)."""
    max_probability: float = Field(0.97, gt=0.5, lt=1)
    """Upper limit of the probability of a voxel: a removed object becomes free space after about ten misses
    (OctoMap)."""
    window_radius: float = Field(6.0, gt=0)
    """Distance from the camera within which blocks are never removed to limit the memory, metres: more than
    `max_depth`."""
    max_blocks: int = Field(8192, gt=0)
    """Maximum number of blocks of 16 x 16 x 16 voxels, 4 kB each: enough for dozens of rooms. Above it, the blocks
    farthest from the camera are removed."""
    max_views: int = Field(1000, gt=0)
    """Maximum number of stored views, 15 kB each, from which the map is rebuilt after corrections of the poses. Above
    it, only the newest of similar views is kept."""
    max_distance: float = Field(1.0, gt=0)
    """Truncation of distances to obstacles, metres: more than the clearance that robots keep."""
    obstacle_heights: tuple[float, float] = (0.15, 1.8)
    """Lowest and highest obstacle in the 2D grid, metres above the floor. Below the lowest lie a voxel and the error of
    the floor at 4 m (1.5 degrees of tilt); the highest is the height of a person."""

    @field_validator("obstacle_heights")
    @classmethod
    def _check_heights(cls, heights: tuple[float, float]) -> tuple[float, float]:
        if not -math.inf < heights[0] < heights[1] < math.inf:
            raise ValueError("the lowest height should be below the highest, and both finite")
        return heights


class StagesConfig(Section):
    """Stages of your own, each by its import path ``module:attribute``; null for the stage of the package.

    The attribute is called with configuration and camera, and returns the stage: see [Your own stage](your_stage.md).
    """

    segment: str | None = None
    """Segmenter: instances of a frame. It replaces `segmentation.source`."""
    smooth_depth: str | None = None
    """Depth re-estimation."""
    detect_features: str | None = None
    """Detector of features."""
    compensate: str | None = None
    """Compensation of rolling shutter and depth delay."""
    odometry: str | None = None
    """Motion of the camera since the previous frame."""
    free_space_check: str | None = None
    """Free-space check."""
    propose_unlabelled: str | None = None
    """Proposal of moving regions without a class."""
    back_project_instances: str | None = None
    """Clouds of the instances."""
    describe_appearance: str | None = None
    """Appearance of the instances."""
    classify_motion: str | None = None
    """Tracks and motion states of the objects."""
    estimate_state: str | None = None
    """Covariance of the pose, and velocity of the camera."""

    @property
    def paths(self) -> dict[str, str]:
        """Import paths by stage, of the stages that are replaced."""
        return {name: path for name, path in self if path is not None}


class CheckpointConfig(Section):
    """Checkpoints, from which an interrupted run is resumed."""

    interval: float = Field(30.0, ge=0)
    """Minimum time between checkpoints, seconds; infinity saves none. With 0, only `max_time_fraction` limits them: 0
    and a fraction of 1 save after every frame."""
    max_time_fraction: float = Field(0.02, gt=0, le=1)
    """Maximum fraction of the run time spent on checkpoints: they grow with the run, and are saved less often."""


class Config(Section):
    """The whole configuration of a run."""

    seed: int = Field(0, ge=0, lt=1 << 63)
    """Seed of all random numbers."""
    threads: int = Field(1, gt=0, le=256)
    """Threads of torch and OpenCV: the tensors of a frame are small, and more threads mostly wait for each other. The
    commands set them; in Python, call `torch.set_num_threads` and `cv2.setNumThreads`."""
    prefetch: bool = True
    """True to preprocess the next frames in threads while one is tracked, and to run the back end in a thread. The
    results are the same."""
    check_numerics: bool = False
    """True to check the results of every stage for NaN and infinity; the error names the first stage that returns one.
    The results are the same. In Python: `v3d_torch.runs.numerics_check.CheckedSLAM`."""
    segmentation: SegmentationConfig = SegmentationConfig()
    depth: DepthConfig = DepthConfig()
    objects: ObjectsConfig = ObjectsConfig()
    features: FeaturesConfig = FeaturesConfig()
    odometry: OdometryConfig = OdometryConfig()
    dense_odometry: DenseOdometryConfig = DenseOdometryConfig()
    tracking: TrackingConfig = TrackingConfig()
    rolling_shutter: RollingShutterConfig = RollingShutterConfig()
    mapping: MappingConfig = MappingConfig()
    loop: LoopConfig = LoopConfig()
    dense_map: DenseMapConfig = DenseMapConfig()
    occupancy: OccupancyConfig = OccupancyConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    stages: StagesConfig = StagesConfig()
