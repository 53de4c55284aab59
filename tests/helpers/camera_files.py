"""Camera files as other programs write them, all of one camera, and the camera itself."""

from __future__ import annotations

from v3d_torch.geometry.camera import PinholeCamera

LENS = (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)
FISHEYE = (-0.0057, 0.0119, -0.0064, 0.0009)
CAMERA = PinholeCamera(517.306408, 516.469215, 318.64304, 255.313989, distortion=LENS)

ORB_SLAM2 = """%YAML:1.0

#--------------------------------------------------------------------------------------------
# Camera Parameters. Adjust them!
#--------------------------------------------------------------------------------------------

# Camera calibration and distortion parameters (OpenCV)
Camera.fx: 517.306408
Camera.fy: 516.469215
Camera.cx: 318.643040
Camera.cy: 255.313989

Camera.k1: 0.262383
Camera.k2: -0.953104
Camera.p1: -0.005358
Camera.p2: 0.002628
Camera.k3: 1.163314

Camera.width: 640
Camera.height: 480

# Camera frames per second
Camera.fps: 30.0

# IR projector baseline times fx (aprox.)
Camera.bf: 40.0

# Color order of the images (0: BGR, 1: RGB. It is ignored if images are grayscale)
Camera.RGB: 1

# Close/Far threshold. Baseline times.
ThDepth: 40.0

# Deptmap values factor
DepthMapFactor: 5000.0

ORBextractor.nFeatures: 1000
Viewer.KeyFrameSize: 0.05
"""

ORB_SLAM3 = """%YAML:1.0

File.version: "1.0"

Camera.type: "PinHole"

Camera1.fx: 517.306408
Camera1.fy: 516.469215
Camera1.cx: 318.643040
Camera1.cy: 255.313989

Camera1.k1: 0.262383
Camera1.k2: -0.953104
Camera1.p1: -0.005358
Camera1.p2: 0.002628
Camera1.k3: 1.163314

Camera.width: 640
Camera.height: 480

Camera.newWidth: 320
Camera.newHeight: 240

Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.07732
IMU.T_b_c1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.]
RGBD.DepthMapFactor: 5000.0
"""

KALIBR = """cam0:
  T_cam_imu:
  - [0.01, -0.99, 0.02, -0.02]
  - [0.99, 0.01, 0.01, -0.06]
  - [-0.02, 0.01, 0.99, 0.01]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [0.262383, -0.953104, -0.005358, 0.002628]
  distortion_model: radtan
  intrinsics: [517.306408, 516.469215, 318.64304, 255.313989]
  resolution: [640, 480]
  rostopic: /camera/color/image_raw
  timeshift_cam_imu: -0.001
"""

ROS = """image_width: 640
image_height: 480
camera_name: rgb_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [517.306408, 0, 318.64304, 0, 516.469215, 255.313989, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.262383, -0.953104, -0.005358, 0.002628, 1.163314]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [521.5, 0, 319.1, 0, 0, 520.2, 254.9, 0, 0, 0, 1, 0]
"""

ROS_TOPIC = """header:
  seq: 12
  stamp:
    secs: 1305031102
    nsecs: 175304000
  frame_id: "/openni_rgb_optical_frame"
height: 480
width: 640
distortion_model: "plumb_bob"
D: [0.262383, -0.953104, -0.005358, 0.002628, 1.163314]
K: [517.306408, 0.0, 318.64304, 0.0, 516.469215, 255.313989, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [521.5, 0.0, 319.1, 0.0, 0.0, 520.2, 254.9, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  do_rectify: False
---
"""
"""Output of ``rostopic echo -n 1``."""

OPENCV = """%YAML:1.0
---
calibration_time: "Mo 02 Nov 2026 10:00:00"
image_width: 640
image_height: 480
flags: 0
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.17306408e+02, 0., 3.1864304e+02, 0., 5.16469215e+02,
       2.55313989e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 2.62383e-01, -9.53104e-01, -5.358e-03, 2.628e-03,
       1.163314 ]
avg_reprojection_error: 2.1e-01
"""

FILES = {
    "ORB-SLAM2": (ORB_SLAM2, 5000.0),
    "ORB-SLAM3": (ORB_SLAM3, 5000.0),
    "Kalibr": (KALIBR, None),
    "ROS": (ROS, None),
    "ROS topic": (ROS_TOPIC, None),
    "ROS 2 topic": (ROS_TOPIC.replace("D:", "d:").replace("K:", "k:").replace("R:", "r:").replace("P:", "p:"), None),
    "OpenCV": (OPENCV, None),
}
"""Text and depth scale of each file."""
