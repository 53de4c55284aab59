"""Choice of topics by type and name."""

from __future__ import annotations

import pytest

from v3d_torch.datasets.ros.bag_topics import CAMERA_INFO, COMPRESSED, IMAGE, choose_topics
from v3d_torch.errors import InputError

REALSENSE = {
    "/camera/camera/color/image_raw": IMAGE,
    "/camera/camera/color/image_raw/compressed": COMPRESSED,
    "/camera/camera/color/camera_info": CAMERA_INFO,
    "/camera/camera/depth/image_rect_raw": IMAGE,
    "/camera/camera/depth/camera_info": CAMERA_INFO,
    "/camera/camera/aligned_depth_to_color/image_raw": IMAGE,
    "/camera/camera/aligned_depth_to_color/image_raw/compressedDepth": COMPRESSED,
    "/camera/camera/aligned_depth_to_color/camera_info": CAMERA_INFO,
    "/camera/camera/infra1/image_rect_raw": IMAGE,
    "/imu": "sensor_msgs/msg/Imu",
}
KINECT = {
    "/camera/rgb/image_color": IMAGE,
    "/camera/rgb/camera_info": CAMERA_INFO,
    "/camera/depth/image": IMAGE,
    "/camera/depth/camera_info": CAMERA_INFO,
    "/cortex_marker_array": "visualization_msgs/msg/MarkerArray",
}
COMPRESSED_ONLY = {
    "/d400/color/image_raw/compressed": COMPRESSED,
    "/d400/color/camera_info": CAMERA_INFO,
    "/d400/aligned_depth_to_color/image_raw/compressed": COMPRESSED,
    "/d400/aligned_depth_to_color/image_raw/compressedDepth": COMPRESSED,
    "/t265/fisheye1/image_raw": IMAGE,
}
OPENNI = {
    "/camera/rgb/image_raw": IMAGE,
    "/camera/rgb/camera_info": CAMERA_INFO,
    "/camera/depth/image_raw": IMAGE,
    "/camera/depth_registered/image_raw": IMAGE,
}
AZURE = {
    "/rgb/image_raw": IMAGE,
    "/rgb/camera_info": CAMERA_INFO,
    "/depth/image_raw": IMAGE,
    "/depth_to_rgb/image_raw": IMAGE,
}
UNLABELLED = {"/sim/image": IMAGE, "/sim/camera_info": CAMERA_INFO, "/sim/depth": IMAGE}


@pytest.mark.parametrize(
    ("types", "rgb", "depth", "info"),
    [
        (
            REALSENSE,
            "/camera/camera/color/image_raw",
            "/camera/camera/aligned_depth_to_color/image_raw",
            "/camera/camera/color/camera_info",
        ),
        (KINECT, "/camera/rgb/image_color", "/camera/depth/image", "/camera/rgb/camera_info"),
        (
            COMPRESSED_ONLY,
            "/d400/color/image_raw/compressed",
            "/d400/aligned_depth_to_color/image_raw/compressedDepth",
            "/d400/color/camera_info",
        ),
        (OPENNI, "/camera/rgb/image_raw", "/camera/depth_registered/image_raw", "/camera/rgb/camera_info"),
        (AZURE, "/rgb/image_raw", "/depth_to_rgb/image_raw", "/rgb/camera_info"),
        (UNLABELLED, "/sim/image", "/sim/depth", "/sim/camera_info"),
    ],
)
def test_topics_are_chosen_by_type_and_name(types: dict[str, str], rgb: str, depth: str, info: str) -> None:
    topics = choose_topics("bag", types)
    assert (topics.rgb, topics.depth, topics.info) == (rgb, depth, info)


def test_choice_between_two_cameras_is_an_error_until_the_user_names_one() -> None:
    types = {f"/{name}{topic}": kind for name in ("left", "right") for topic, kind in KINECT.items()}
    with pytest.raises(
        InputError, match="bag: has several topics of colour images; set --rgb-topic to one of /left/cam"
    ):
        choose_topics("bag", types)
    topics = choose_topics("bag", types, rgb="/right/camera/rgb/image_color")
    assert (topics.depth, topics.info) == ("/right/camera/depth/image", "/right/camera/rgb/camera_info")
    topics = choose_topics("bag", types, "/right/camera/rgb/image_color", "/left/camera/depth/image")
    assert topics.depth == "/left/camera/depth/image"


def test_depth_of_the_same_camera_is_preferred_to_registered_depth_of_another() -> None:
    types = {"/front/color/image_raw": IMAGE, "/front/aligned_depth_to_color/image_raw": IMAGE}
    types |= {"/rear/color/image_raw": IMAGE, "/rear/depth/image_raw": IMAGE}
    assert choose_topics("bag", types, rgb="/rear/color/image_raw").depth == "/rear/depth/image_raw"
    topics = choose_topics("bag", types, rgb="/front/color/image_raw")
    assert topics.depth == "/front/aligned_depth_to_color/image_raw" and topics.is_registered
    del types["/rear/depth/image_raw"]
    topics = choose_topics("bag", types, rgb="/rear/color/image_raw")
    assert topics.depth == "/front/aligned_depth_to_color/image_raw" and not topics.is_registered


@pytest.mark.parametrize(
    ("rgb", "is_rectified"),
    [
        ("/camera/rgb/image_rect_color", True),
        ("/camera/rgb/rectified", True),
        ("/camera/rgb/image_raw", False),
        ("/direct/rgb/image_raw", False),
        ("/camera/rgb/image_corrected", False),
    ],
)
def test_word_in_the_name_implies_rectified_images(rgb: str, is_rectified: bool) -> None:
    types = {rgb: IMAGE, "/camera/depth/image": IMAGE}
    assert choose_topics("bag", types).is_rectified == is_rectified


def test_colour_is_found_next_to_a_depth_topic_of_any_name() -> None:
    types = {"/a": IMAGE, "/b": IMAGE}
    assert choose_topics("bag", types, depth="/a").rgb == "/b"
