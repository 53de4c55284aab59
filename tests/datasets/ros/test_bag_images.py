"""Decoding of ROS image messages: all encodings, byte orders and compressions, and invalid messages."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bags import MessageFactory, compressed_depth, png
from helpers.tiny_images import HEIGHT, WIDTH, as_rgb, colour_of, depth_of
from PIL import Image

from v3d_torch.datasets.ros.bag_images import decode_colour_message, decode_depth_message
from v3d_torch.errors import InputError
from v3d_torch.geometry.depth_units import depth_to_metres

ROS2 = MessageFactory("db3")


def decode_metres(message: Any, depth_scale: float) -> torch.Tensor:
    """Decode a depth message and convert it to metres."""
    return depth_to_metres(decode_depth_message(message, "x"), depth_scale)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", colour_of(0)),
        ("bgr8", colour_of(0)[..., ::-1]),
        ("8UC3", colour_of(0)[..., ::-1]),
        ("rgba8", np.dstack([colour_of(0), colour_of(1)[..., :1]])),
        ("bgra8", np.dstack([colour_of(0)[..., ::-1], colour_of(1)[..., :1]])),
    ],
)
@pytest.mark.parametrize("pad", [0, 5])
def test_raw_colour_of_all_channel_orders_is_rgb(encoding: str, pixels: Any, pad: int) -> None:
    image = decode_colour_message(ROS2.image(1, encoding, pixels, pad=pad), "x")
    assert image.dtype == torch.uint8 and np.array_equal(as_rgb(image), colour_of(0))


def test_decoded_images_do_not_share_memory_with_the_message() -> None:
    colour, depth = ROS2.image(1, "rgb8", colour_of(0)), ROS2.image(1, "16UC1", depth_of(0))
    images = decode_colour_message(colour, "x"), decode_metres(depth, 1000)
    for message, image in zip((colour, depth), images, strict=True):
        before = image.clone()
        message.data[:] = 7
        assert torch.equal(image, before)


def test_grey_bayer_and_yuv_are_converted_to_rgb() -> None:
    grey = colour_of(0)[..., 0]
    for encoding in ("mono8", "8UC1"):
        assert np.array_equal(as_rgb(decode_colour_message(ROS2.image(1, encoding, grey), "x")), np.dstack([grey] * 3))
    # A red scene: the name of the encoding gives the position of the red pixel.
    for encoding, (row, column) in {"rggb": (0, 0), "grbg": (0, 1), "gbrg": (1, 0), "bggr": (1, 1)}.items():
        mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
        mosaic[row::2, column::2] = 200
        image = decode_colour_message(ROS2.image(1, f"bayer_{encoding}8", mosaic), "x")[:, 4:-4, 4:-4]
        assert image[0].min() == 200 and image[1:].max() == 0
    for encoding, (y, u, v) in {
        "yuv422": (1, 0, 2),
        "uyvy": (1, 0, 2),
        "yuyv": (0, 1, 3),
        "yuv422_yuy2": (0, 1, 3),
    }.items():
        packed = np.zeros((HEIGHT, WIDTH // 2, 4), np.uint8)
        packed[..., [y, (y + 2)]], packed[..., u], packed[..., v] = 81, 90, 240  # red in BT.601
        image = decode_colour_message(ROS2.image(1, encoding, packed.reshape(HEIGHT, WIDTH, 2)), "x")
        assert image[0].min() > 250 and image[1:].max() < 5


def test_compressed_colour_is_decoded() -> None:
    png_image = decode_colour_message(ROS2.compressed(1, "rgb8; png compressed bgr8", png(colour_of(0))), "x")
    assert np.array_equal(as_rgb(png_image), colour_of(0))
    file = BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), (250, 120, 10)).save(file, "jpeg", quality=100)
    image = decode_colour_message(ROS2.compressed(1, "bgr8; jpeg compressed bgr8", file.getvalue()), "x")
    assert (image[:, 8, 8].int() - torch.tensor([250, 120, 10])).abs().max() <= 2


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("pad", [0, 6])
def test_convention_depth_is_metres_and_zero_is_no_measurement(big_endian: bool, pad: int) -> None:
    units = depth_of(0)
    for encoding in ("16UC1", "mono16"):
        depth = decode_metres(ROS2.image(1, encoding, units, pad=pad, big_endian=big_endian), 1000)
        np.testing.assert_allclose(depth[0], units / 1000, rtol=1e-6)
    metric = (units / 1000).astype(np.float32)
    metric[0, :4] = [np.nan, np.inf, -np.inf, -1]
    depth = decode_metres(ROS2.image(1, "32FC1", metric, pad=pad, big_endian=big_endian), 5000)
    expected = np.where(np.isfinite(metric) & (metric > 0), metric, 0)
    assert depth.dtype == torch.float32 and np.array_equal(depth[0].numpy(), expected)


def test_compressed_depth_of_integers_and_floats_is_decoded() -> None:
    units = depth_of(0)
    for compression in ("16UC1; compressedDepth", "16UC1; compressedDepth png"):
        depth = decode_metres(ROS2.compressed(1, compression, compressed_depth(units)), 1000)
        np.testing.assert_allclose(depth[0], units / 1000, rtol=1e-6)
    depth = decode_metres(ROS2.compressed(1, "16UC1; png compressed ", png(units)), 1000)
    np.testing.assert_allclose(depth[0], units / 1000, rtol=1e-6)
    # The transport stores floats as quantised inverse depth in 16 bits; its defaults are 100 and 10 m.
    a, max_depth = 100.0 * 101.0, 10.0
    b = 1 - a / max_depth
    metric = np.linspace(0.3, 9.9, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    stored = np.rint(a / metric + b).astype(np.uint16)
    stored[0, 0] = 0
    depth = decode_metres(ROS2.compressed(1, "32FC1; compressedDepth", compressed_depth(stored, a, b)), 1000)
    assert depth[0, 0, 0] == 0
    np.testing.assert_allclose(depth[0].numpy().flat[1:], metric.flat[1:], atol=0.5 * 9.9**2 / a * 1.1)


@pytest.mark.parametrize(
    ("kind", "message", "error"),
    [
        (
            "colour",
            ROS2.image(1, "16UC1", depth_of(0)),
            "holds 16UC1 images, not colour; choose another topic with --rgb-topic",
        ),
        (
            "depth",
            ROS2.image(1, "rgb8", colour_of(0)),
            "holds rgb8 images, not depth; choose another topic with --depth-topic",
        ),
        ("depth", ROS2.compressed(1, "16UC1; compressedDepth rvl", b"1" * 40), "RVL-compressed depth is not supported"),
        ("depth", ROS2.compressed(1, "16UC1; compressedDepth", b"1" * 40), "is not a PNG, JPEG or TIFF image"),
        ("depth", ROS2.compressed(1, "mono8; png compressed", png(colour_of(0)[..., 0])), "8-bit"),
        ("colour", ROS2.compressed(1, "bgr8; jpeg compressed bgr8", png(colour_of(0))[:-40]), "truncated"),
        (
            "colour",
            ROS2.compressed(1, "16UC1; png compressed", png(depth_of(0))),
            "is a 16-bit depth image, expected a colour image",
        ),
    ],
)
def test_invalid_message_is_an_input_error(kind: str, message: Any, error: str) -> None:
    with pytest.raises(InputError, match=f"^here: .*{error}"):
        decode_colour_message(message, "here") if kind == "colour" else decode_depth_message(message, "here")


def test_image_with_too_little_data_is_an_input_error() -> None:
    message = ROS2.image(1, "rgb8", colour_of(0))
    message.data = message.data[:-1]
    with pytest.raises(InputError, match="less data than its 32x24 pixels"):
        decode_colour_message(message, "here")
