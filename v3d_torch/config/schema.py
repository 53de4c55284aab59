"""Typed configuration: a section per stage, each constant with its unit and its reason.

`v3d_torch.config.loading` reads it from YAML and the command line; the resolved whole is written beside each result.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """A part of the configuration: immutable, and refuses keys that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SegmentationConfig(Section):
    """Instance segmentation (paper, Sec. III-A)."""

    source: Literal["yolo", "masks", "none"] = "yolo"
    """Where instances come from: the network, a folder of id images, or nowhere (the baseline without masks)."""
    model: Literal["yolov8n-seg", "yolo11n-seg", "yolo26n-seg"] = "yolov8n-seg"
    """The paper names YOLOv8; the nano model is the one that runs on a CPU beside everything else."""
    height: int = Field(320, gt=0, multiple_of=32)
    """Rows of the network's input, pixels: two thirds of the usual RGB-D image take half the time, and what the network
    misses in it, the outlines make up for. A person at 6 m is still about 100 pixels high."""
    width: int = Field(416, gt=0, multiple_of=32)
    """Columns of the network's input, pixels."""
    precision: Literal["int8", "float32"] = "int8"
    """Numbers of the network's convolutions. 8-bit integers take half the time, on processors made for them (others
    take float32), and lose less than a quarter of a percent of the moving pixels on any of the composed sequences."""
    score_threshold: float = Field(0.25, ge=0, le=1)
    """Least class score. The paper leaves it open; 0.25 is the authors of YOLOv8's own. A missed person costs more
    than a false one."""
    iou_threshold: float = Field(0.7, ge=0, le=1)
    """Boxes of one class that overlap more than this are one instance (non-maximum suppression; YOLOv8's own)."""
    duplicate_overlap: float = Field(0.7, gt=0, le=1)
    """An instance of which more than this lies within a better one of its class is that one seen again, or its part."""
    upright: bool = True
    """Whether the network is shown the images of a rolled camera upright (off in the paper)."""
    max_instances: int = Field(32, gt=0)
    """Most instances kept in an image, by score: bounds memory, far above what a room shows."""
    threads: int = Field(1, gt=0, le=256)
    """Threads of the inference engine. It runs beside tracking, from which on two cores a second one takes the time."""


class DepthConfig(Section):
    """Depth re-estimation (paper, Sec. III-B.1)."""

    kernel_size: Literal[1, 3, 5, 7, 9, 11, 13, 15] = 5
    """Side of the Gaussian window, pixels (the authors' code)."""
    sigma: float = Field(1.0, gt=0)
    """Standard deviation of the Gaussian, pixels (the authors' code)."""
    edge_ratio: float = Field(0.05, gt=0)
    """Neighbours whose depth differs by more than this share of the centre's lie behind an edge and stay out."""


class CloudConfig(Section):
    """Instance clouds and their outlier rejection (paper, Sec. III-B.2)."""

    stride: int = Field(4, gt=0, le=100)
    """Every n-th pixel of a mask becomes a point: the network draws masks in cells of 4 pixels and more. Up to 4 m a
    Kinect's points are then no farther apart than 0.03 m, and DBSCAN's radius is 0.08."""
    max_depth: float = Field(6.0, gt=0)
    """Farther points are left out, metres: a Kinect's depth is good to 10 cm there, as much as what is to be found."""
    voxel_size: float = Field(0.02, gt=0)
    """Side of a voxel, metres (the authors' code)."""
    eps: float = Field(0.08, gt=0)
    """DBSCAN's radius, metres: four voxels bridge the stripes of a Kinect at 4 m, not a person and the wall behind."""
    min_samples: int = Field(5, gt=0)
    """DBSCAN's core size, points."""
    min_points: int = Field(30, gt=0)
    """A cluster with fewer voxels is no object: its centroid would be noise."""


class TrackerConfig(Section):
    """Ids of objects over frames, and objects that the network misses for a while (paper, Sec. III)."""

    max_speed: float = Field(3.0, gt=0)
    """No object in a room moves faster, m/s: a person who runs. A centroid farther off is another object's."""
    max_jump: float = Field(0.5, gt=0)
    """By so much a centroid may be off in any time, metres: it moves when an object is cut or covered."""
    centroid_sigma: float = Field(0.05, gt=0)
    """Standard deviation of the centroid of an object wholly in sight, metres: arms and legs swing by more, outlines
    err by less."""
    partial_sigma: float = Field(0.45, ge=0)
    """What comes on top where nearly nothing of the object is in sight, metres; in between by the share that is not.
    A person cut off at the waist has a centroid a quarter of a height off."""
    acceleration_noise: float = Field(2.0, gt=0)
    """Standard deviation of the change of velocity in a second, m/s^2: who walks can stop or turn within one."""
    min_overlap: float = Field(0.4, ge=0, le=1)
    """An instance of another class continues an object only where their masks overlap by this: a class may flicker
    between frames, but a cup does not turn into the table under it. At 0.5 ids of people change
    more often on each of the composed sequences with a moving camera."""
    max_missed_time: float = Field(0.5, ge=0)
    """An object that is not seen is predicted for so long, seconds: about a step of a person who walks. 0 for the
    ablation."""
    history: float = Field(1.0, gt=0)
    """Centroids are remembered for so long, seconds: bounds the longest baseline of the vote."""


class VotingConfig(Section):
    """Spatial-reasoned Hough voting (paper, Sec. III-C, Alg. 1)."""

    enabled: bool = True
    """Off for the ablation."""
    distance_threshold: float = Field(0.05, gt=0)
    """T_d, metres: a change of the distance between two centroids that counts as a vote."""
    vote_threshold: int = Field(2, gt=0)
    """T_v, votes that make an object dynamic (authors' code: more than one)."""
    baselines: tuple[float, ...] = (0.0, 0.3, 0.9)
    """Distances now are compared with those so many seconds ago; 0 is the frame before, the paper's rule. A walker at
    1 m/s changes by 3 cm in 1/30 s, no more than a centroid's noise, and by 30 cm in 0.3 s."""


class FreeSpaceConfig(Section):
    """The background's word on who moves: whether an object's places are still filled, by the camera's motion.

    It has the casting vote. Centroids and clouds also change when an object is cut by the image border, covered or
    segmented differently; and two walkers would outvote every chair.
    """

    enabled: bool = True
    """Off for the paper's literal rules."""
    baselines: tuple[float, ...] = (0.3, 0.9)
    """What is seen now is compared with what was seen so many seconds ago: a walker goes 0.3 m in the first, somebody
    slow in the second."""
    moved_share: float = Field(0.5, gt=0, le=1)
    """An object has moved when at least half of it, of what is in sight, has."""
    deformed_share: float = Field(0.1, gt=0, le=1)
    """It has deformed when so much has. Silhouettes err by a pixel or two and make up some hundredths of a person; a
    torso of 0.4 m that sways by 4 cm reaches this."""
    still_share: float = Field(0.1, gt=0, le=1)
    """It stands still when less than this came over each of the baselines: outlines err by some hundredths."""
    min_unlabelled_area: float = Field(0.02, gt=0)
    """What came, has no name and is smaller, is noise, square metres: a hand with its forearm is about this. Infinite
    for the ablation."""
    max_depth: float = Field(6.0, gt=0)
    """Farther points are not looked at, metres: their depth errs by as much as what is to be found."""
    tolerance: float = Field(0.01, gt=0)
    """Depth that differs by this times z^2 is the same, 1/m: four times a structured-light camera's error."""
    min_tolerance: float = Field(0.04, gt=0)
    """And so is depth that differs by this, metres: the thickness of clothes and of a voxel."""
    depth_sync_error: float = Field(0.02, ge=0, le=1)
    """Colour and depth of a frame are taken so far apart, seconds: TUM pairs what is no farther, and a rolling shutter
    takes as long to read half an image. A camera that turns sees them as many pixels apart as it turns meanwhile."""
    min_depth: float = Field(0.3, gt=0)
    """Nearer points are out of such a camera's range, metres."""
    min_points: int = Field(30, gt=0)
    """Fewer points in sight tell nothing."""


class ChamferConfig(Section):
    """Intra-object motion by Chamfer distance (paper, Sec. III-D)."""

    enabled: bool = True
    """Off for the ablation."""
    distance_threshold: float = Field(0.025, gt=0)
    """Root mean nearest-neighbour distance that means deformation, metres: sqrt(D / 2) with D the paper's sum of two
    mean squares. Two samplings of a still surface by 2 cm voxels differ by 1 cm, Kinect noise at 3 m adds as much."""
    baseline: float = Field(0.3, ge=0)
    """The cloud is compared with the one so many seconds ago; 0 is the frame before, the paper's rule."""
    keep_deforming_features: bool = False
    """Whether features on deforming objects are kept. The paper's text says both; its code leaves them out."""


class StaticMaskConfig(Section):
    """What is left out of tracking."""

    confirm_static_time: float = Field(1.0, ge=0)
    """A person is taken for moving until seen still for so long, seconds (the paper sets persons aside till judged)."""
    fit_share: float = Field(0.5, ge=0, le=1)
    """Unless of its features, compared with the rest of the image, at least this share fits the camera's motion."""
    fit_least: int = Field(10, gt=0)
    """Fewer features vouch for nobody: some lie on the rim of whoever hides the rest."""
    hold_dynamic_time: float = Field(1.0, ge=0)
    """An object judged dynamic or deforming stays so for this long after the last evidence, seconds: gaits pause. A
    thing that is seen at rest is released at once."""
    confirm_dynamic_frames: int = Field(2, gt=0)
    """The verdict is held only after so many frames with evidence: one may be noise of the depth."""
    bridge_score: float = Field(0.3, ge=0)
    """A missed object that was never seen to move is left out if the scores of its sightings add up to this: two weak
    ones or a strong one. The network sees a person in rolled furniture for single frames."""
    dilation: int = Field(2, ge=0, le=100)
    """Pixels by which a left-out mask grows whatever the depth: colour and depth are not aligned better."""
    depth_margin: int = Field(8, ge=0, le=100)
    """Pixels by which it grows where the depth is the object's own, or missing: a network mask at a quarter of the
    resolution errs by about two of its pixels."""
    surface_margin: int = Field(32, ge=0, le=1000)
    """Pixels by which it grows over surface that goes on without an edge: a hand at 3 m. The more it may, the more
    of a table goes with whoever touches it. 0 turns it off."""
    edge_ratio: float = Field(0.04, gt=0)
    """Depth that differs by more than this share of it from one pixel to the fourth next is an edge: a surface seen
    at 80 degrees differs by 0.03."""
    min_surface_fraction: float = Field(0.4, ge=0, le=1)
    """It does not grow over a surface of which it would be a smaller part than this: the floor, a table."""
    depth_tolerance: float = Field(0.05, gt=0)
    """Depth within this of the points around it is the object's own, metres; its error, with z^2, comes on top."""
    tolerance_growth: float = Field(0.01, ge=0)
    """Growth of that with the square of depth, 1/m: four times a structured-light camera's error."""


class ObjectsConfig(Section):
    """The object stage: clouds, ids, who moves."""

    clouds: CloudConfig = CloudConfig()
    tracker: TrackerConfig = TrackerConfig()
    voting: VotingConfig = VotingConfig()
    free_space: FreeSpaceConfig = FreeSpaceConfig()
    chamfer: ChamferConfig = ChamferConfig()
    static_mask: StaticMaskConfig = StaticMaskConfig()


class FeaturesConfig(Section):
    """ORB features (paper, Sec. III-A and III-E)."""

    count: int = Field(1500, gt=0)
    """Features asked of the detector. More than ORB-SLAM2's 1000, as people take their share: with 1000 walkers_desk
    has an ATE of 7.6 mm, with 1500 6.7, with 2500 6.4 and 6 ms more of CPU time a frame (medians of 3 seeds)."""
    levels: int = Field(8, gt=0, le=20)
    """Levels of the scale pyramid (ORB-SLAM2)."""
    scale: float = Field(1.2, gt=1)
    """Ratio of neighbouring levels (ORB-SLAM2)."""
    cell: int = Field(32, gt=0)
    """Side of the cells over which features are spread where not all are used, pixels."""
    max_depth: float = Field(8.0, gt=0)
    """Depth beyond is taken for none, metres: the Kinect's error there is 0.2 m and more."""


class OdometryConfig(Section):
    """Camera motion between two frames (paper, Sec. III-E)."""

    max_features: int = Field(500, gt=0)
    """Features of a frame that are matched to all of the next one, spread over the image. Twice as many take 1 ms more,
    and the camera is followed no better: the map refines what they tell. Places are looked for with all features: with
    500, fr1_rpy is not found again after 150 frames."""
    max_ratio: float = Field(0.8, gt=0, le=1)
    """Lowe's ratio between the best and the second Hamming distance."""
    max_hamming: int = Field(64, gt=0, le=256)
    """Farther descriptors do not match, bits of 256."""
    epipolar_threshold: float = Field(2.0, gt=0)
    """Sampson distance of inliers to the epipolar constraint, pixels."""
    pnp_threshold: float = Field(4.0, gt=0)
    """Reprojection error of inliers of PnP-RANSAC, pixels."""
    iterations: int = Field(300, gt=0)
    """Most hypotheses of either RANSAC: finds a sample of 5 at half outliers with probability 0.9999."""
    min_inliers: int = Field(20, gt=0)
    """Fewer do not make a motion: a dozen of wrong matches agree by chance."""
    max_speed: float = Field(5.0, gt=0)
    """No hand moves a camera faster, m/s; between two frames a motion beyond is wrong."""
    max_rotation_rate: float = Field(6.3, gt=0)
    """Nor turns it faster, rad/s: a full turn in a second."""


class DenseOdometryConfig(Section):
    """Camera motion from all pixels, where features fail."""

    halvings: tuple[int, ...] = (4, 2, 1)
    """How often the image is halved on each level, coarse to fine. A turn of 60 pixels from frame to frame is 4 on the
    coarsest. Full resolution takes half as long again, gains 0.1 mm on the demo and nothing on real images."""
    max_points: int = Field(5000, gt=0)
    """About so many pixels of a level take part, one of each cell: bounds the time. On the demo, twice as many gain
    0.03 mm."""
    iterations: int = Field(10, gt=0)
    """Most Levenberg-Marquardt steps on a level."""
    max_depth: float = Field(8.0, gt=0)
    """Depth beyond is taken for none, metres, as for features."""
    edge_ratio: float = Field(0.05, gt=0)
    """Neighbours whose depth differs by more than this share lie on two surfaces, as in the depth's re-estimation."""
    occlusion: float = Field(0.1, gt=0)
    """Where inverse depth differs by more than this share, something else is seen: it tells nothing of the motion."""
    degrees_of_freedom: float = Field(5.0, gt=0)
    """Degrees of freedom of the t-distribution (Kerl et al., ICRA 2013, who found it from residuals)."""
    inverse_depth_sigma: float = Field(0.003, gt=0)
    """Least standard deviation of inverse depth, 1/m: twice the sensor's (Khoshelham and Elberink, Sensors 2012)."""
    coarse_inverse_depth_sigma: float = Field(0.02, gt=0)
    """The same above the finest level, so that brightness leads there: depth is taken at another time than colour, and
    in a fast turn tells of another motion, which is an optimum of its own."""
    min_overlap: float = Field(0.3, gt=0, le=1)
    """Share of the reference's points that the current view must see."""
    min_inlier_share: float = Field(0.75, gt=0, le=1)
    """Share of those points, of the ones with depth, whose depth must agree."""
    min_correlation: float = Field(0.9, gt=0, le=1)
    """Least correlation of both views' brightness; unlike a residual it does not depend on light."""
    min_observability: float = Field(1e-3, gt=0, le=1)
    """Smallest over greatest eigenvalue of the information, translation measured in median depths: below, some motion
    is not seen, as along a wall without texture. Of 693 pairs of neighbouring frames of TUM's fr1_rpy, 2 lie below."""


class TrackingConfig(Section):
    """Frames against the local map."""

    search_radius: float = Field(10.0, gt=0)
    """Radius around a landmark's projection in which it is looked for, pixels at level 0; grows with the level."""
    max_hamming: int = Field(64, gt=0, le=256)
    """Farther descriptors do not match, bits of 256."""
    max_ratio: float = Field(0.9, gt=0, le=1)
    """Lowe's ratio among the candidates within the radius."""
    inverse_depth_sigma: float = Field(0.025, gt=0)
    """Standard deviation of inverse depth, 1/m; depth itself errs by this times z^2. A still plane gives 0.0014
    (Khoshelham and Elberink, Sensors 2012), but corners lie on depth edges, and colour and depth are taken at different
    times and not perfectly aligned. ORB-SLAM2's setting: a pixel of disparity at a baseline of 40 pixel metres."""
    pixel_sigma: float = Field(1.0, gt=0)
    """Standard deviation of a feature's place at level 0, pixels."""
    min_inliers: int = Field(20, gt=0)
    """Fewer landmarks found: the camera is lost."""
    local_keyframes: int = Field(15, gt=0)
    """Keyframes whose landmarks make up the local map."""


class MappingConfig(Section):
    """Keyframes and landmarks."""

    enabled: bool = True
    """Off: the camera is localised in a map that was loaded, and the map stays as it is."""
    max_keyframe_interval: int = Field(20, gt=0)
    """At the latest after so many frames there is a new keyframe, frames."""
    min_tracked_ratio: float = Field(0.75, gt=0, le=1)
    """A frame that finds fewer landmarks than this share of what was found since the last keyframe becomes a keyframe
    (ORB-SLAM2's share for RGB-D)."""
    min_tracked: int = Field(100, gt=0)
    """So does one that finds fewer landmarks than this."""
    map_by_odometry_after: float = Field(0.5, ge=0)
    """A camera that finds nothing of the map for so long, and knows its motion, maps on by that, seconds. Motions add
    up their errors; most often the map is found again first."""
    restart_after: float = Field(1.0, gt=0)
    """A camera that sees enough and is lost for so long maps on from where it is guessed to be, seconds; its poses are
    flagged as disconnected."""
    landmarks_per_keyframe: int = Field(1000, gt=0)
    """Landmarks that a keyframe sees at most, old and new (ORB-SLAM2's number of features)."""
    fusion_keyframes: int = Field(10, ge=0)
    """Neighbours in which the landmarks of a new keyframe are looked for (ORB-SLAM2, which takes 10 for RGB-D)."""
    fuse_radius: float = Field(3.0, gt=0)
    """Radius of that search, pixels at level 0 (ORB-SLAM2): both poses are known by then."""
    redundant_ratio: float = Field(0.9, gt=0, le=1)
    """A keyframe goes when more of its landmarks than this are seen well enough by others (ORB-SLAM2). 1 keeps all."""
    redundant_views: int = Field(3, gt=0)
    """And so many others must see them (ORB-SLAM2)."""
    bundle_keyframes: int = Field(15, ge=0)
    """Keyframes that move in a local bundle adjustment, as many as make up the local map; 0 turns it off. With 8 the
    map of fr1_rpy bends by a fifth more."""
    bundle_iterations: int = Field(5, gt=0)
    """Levenberg-Marquardt steps of a local bundle adjustment, at most."""
    bundle_tolerance: float = Field(1e-5, gt=0)
    """A step that changes the cost by a smaller share is the last. The cost is some thousands of squared standard
    deviations: a small part of one is left to gain, and the next keyframe goes on from there."""


class RollingShutterConfig(Section):
    """What is read when, while the camera moves: the rows of colour one after the other, depth at a time of its own."""

    enabled: bool = True
    """Off: all rows of both images are taken for read at once."""
    readout: float = Field(0.02, ge=-0.05, le=0.05)
    """Time from the first row to the last, seconds, as long as neither the camera nor the map tells another. The colour
    cameras of most RGB-D cameras roll (Kinect, Xtion, D415, D435), and take 20 to 30 ms; of some, all rows are read at
    once (D455). Were none expected, the first frames would be off, before the map can tell."""
    readout_sigma: float = Field(0.015, gt=0)
    """How sure that is, standard deviation, seconds: a global shutter and the slowest are both within 2 of it."""
    calibration_keyframes: int = Field(20, ge=0)
    """So many keyframes ask the map, and then every tenth: what was learnt moves all that the map has seen."""


class MeshConfig(Section):
    """The triangle mesh of what stands still."""

    enabled: bool = False
    """Whether there is one: it takes 5 s for the 99 keyframes of TUM's fr1/rpy."""
    voxel_size: float = Field(0.02, gt=0)
    """Side of a voxel, metres: the pixels kept lie 1.5 cm apart at 4 m, and depth errs by 2 cm there. Half of it takes
    four times as long."""
    truncation: float = Field(0.08, gt=0)
    """Surfaces are taken to be so thick, metres: three times the error of depth at 4 m, and of poses."""


class DenseMapConfig(Section):
    """The coloured map of what stands still, and its mesh."""

    stride: int = Field(2, gt=0, le=100)
    """Every n-th pixel of a keyframe goes into the map, by row and by column: 8 mm apart at 2 m, less than a voxel."""
    max_depth: float = Field(4.0, gt=0)
    """Farther pixels stay out, metres: their noise would blur the map."""
    voxel_size: float = Field(0.01, gt=0)
    """Side of a voxel, metres: about the depth noise at 2 m."""
    mesh: MeshConfig = MeshConfig()


class LoopConfig(Section):
    """Loop closing and pose graph (paper, Sec. III-E)."""

    enabled: bool = True
    """Off for the ablation."""
    candidates: int = Field(3, gt=0)
    """Places looked at for each keyframe."""
    min_keyframe_gap: int = Field(10, gt=0)
    """Keyframes nearer in time than this are no loop; nor is one looked for so soon after another."""
    min_inliers: int = Field(40, gt=0)
    """Inliers of the geometric verification."""
    min_inlier_ratio: float = Field(0.15, ge=0, le=1)
    """Share of the landmarks that the place should show of which so many must be inliers: with fewer a pose is less
    sure than the drift that it would correct. A camera that is lost takes what there is."""


class CheckpointConfig(Section):
    """What is written while a run goes, so that little is lost when it is killed."""

    interval: float = Field(30.0, ge=0)
    """So often at most, seconds: as much work is lost. 0 is after every frame, infinite never."""
    max_time_share: float = Field(0.02, gt=0, le=1)
    """Of the time no more than this goes into it: the longer a run, the more there is to write, and the less often."""


class Config(Section):
    """The whole configuration of a run."""

    seed: int = Field(0, ge=0, lt=1 << 63)
    """Seed of every random choice."""
    threads: int = Field(1, gt=0, le=256)
    """Threads of torch and OpenCV: the tensors of a frame are so small that more threads wait for each other."""
    prefetch: bool = True
    """Whether the next frames are read, segmented and lifted while one is tracked, in another thread or, where a stored
    sequence is long enough, another process, and the map adjusted behind in a thread; the results are the same."""
    check_numerics: bool = False
    """Debug mode: whatever leaves a stage is looked through for NaN and infinity, and the first stage that gives some
    is named. The results are the same. In Python it is `v3d_torch.runs.numerics_check.CheckedSLAM`."""
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
    checkpoint: CheckpointConfig = CheckpointConfig()
