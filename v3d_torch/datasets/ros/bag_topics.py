"""Choice of the colour, depth and CameraInfo topics of a bag, by the user or from topic types and names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import takewhile

from v3d_torch.errors import InputError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

_COLOUR = re.compile(r"rgb|colou?r", re.IGNORECASE)
_DEPTH = re.compile(r"depth", re.IGNORECASE)
_REGISTERED = re.compile(r"aligned|registered|depth_to_(rgb|colou?r)", re.IGNORECASE)
_NEITHER = re.compile(r"infra|/ir\d?/|fisheye|mask|label|segment|theora|confidence", re.IGNORECASE)
"""Names of images that are neither colour nor depth, or that cannot be decoded here (theora)."""
_RECTIFIED = re.compile(r"(?<![a-z])rect", re.IGNORECASE)
"""Start of a word: other words, such as ``direct`` and ``corrected``, contain the same letters."""


@dataclass(frozen=True)
class BagTopics:
    """Names of the topics that are read from a bag.

    Attributes:
        rgb: Topic of the colour images.
        depth: Topic of the depth images.
        info: CameraInfo topic of the colour camera; None if the bag has none.
    """

    rgb: str
    depth: str
    info: str | None

    @property
    def is_rectified(self) -> bool:
        """True if the name of the colour topic implies that the images are undistorted."""
        return bool(_RECTIFIED.search(self.rgb))

    @property
    def is_registered(self) -> bool:
        """True if the topic names imply that depth is registered to colour, pixel by pixel, of the same camera."""
        return bool(_REGISTERED.search(self.depth)) and shared_parts(self.depth, self.rgb) > 0


def choose_topics(
    bag: object, types: Mapping[str, str], rgb: str | None = None, depth: str | None = None, info: str | None = None
) -> BagTopics:
    """Choose the topics of a bag.

    Args:
        bag: Path of the bag, for error messages.
        types: Message type of each topic.
        rgb: Colour topic chosen by the user; None to prefer raw images to rectified and compressed ones.
        depth: Depth topic chosen by the user; None to prefer depth of the same camera, then depth registered to colour.
        info: CameraInfo topic chosen by the user; None for the one next to the colour topic.

    Returns:
        Chosen topics.

    Raises:
        InputError: If a chosen topic is missing or has another type, no topic fits, or the choice is ambiguous.
    """
    images = {topic: kind for topic, kind in types.items() if kind in (IMAGE, COMPRESSED)}
    if not images:
        raise InputError(f"{bag}: contains no images; record the colour, depth and CameraInfo topics")
    for option, topic in (("rgb", rgb), ("depth", depth)):
        if topic is not None and topic not in images:
            raise InputError(f"{bag}: has no images on {topic}; set --{option}-topic to one of {_join(images)}")
    candidates = [topic for topic in images if not _NEITHER.search(topic)]
    if rgb is None:
        not_depth = [topic for topic in candidates if not _DEPTH.search(topic) and topic != depth]
        named_colour = [topic for topic in not_depth if _COLOUR.search(topic)]
        rgb_ranks = {
            topic: (bool(_RECTIFIED.search(topic)), _compression_rank(topic, images))
            for topic in named_colour or not_depth
        }
        rgb = _choose_best(bag, "colour", "rgb", rgb_ranks, images)
    if depth is None:
        depth_ranks = {
            topic: (-shared_parts(topic, rgb), not _REGISTERED.search(topic), _compression_rank(topic, images))
            for topic in candidates
            if _DEPTH.search(topic) and topic != rgb
        }
        depth = _choose_best(bag, "depth", "depth", depth_ranks, images)
    infos = [topic for topic, kind in types.items() if kind == CAMERA_INFO]
    if info is not None and info not in infos:
        if not infos:
            raise InputError(f"{bag}: has no CameraInfo on {info} or any other topic; pass --camera instead")
        raise InputError(f"{bag}: has no CameraInfo on {info}; set --info-topic to one of {_join(infos)}")
    return BagTopics(rgb, depth, info or next((topic for topic in infos if topic in _info_topics_of(rgb)), None))


def _choose_best(
    bag: object, kind: str, option: str, ranks: Mapping[str, tuple[int, ...]], images: Mapping[str, str]
) -> str:
    """Return the only topic of the lowest rank."""
    if not ranks:
        raise InputError(f"{bag}: no topic is named like {kind} images; set --{option}-topic to one of {_join(images)}")
    best = [topic for topic, rank in ranks.items() if rank == min(ranks.values())]
    if len(best) > 1:
        raise InputError(f"{bag}: has several topics of {kind} images; set --{option}-topic to one of {_join(best)}")
    return best[0]


def _compression_rank(topic: str, images: Mapping[str, str]) -> int:
    """Return 0 for raw images, 1 for lossless depth, 2 for other compression, which can damage depth."""
    return 0 if images[topic] == IMAGE else 1 if topic.endswith("compressedDepth") else 2


def shared_parts(topic: str, other: str) -> int:
    """Number of leading name parts that two topics share; topics of one camera share most."""
    pairs = zip(topic.strip("/").split("/"), other.strip("/").split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _info_topics_of(rgb: str) -> list[str]:
    """Topics on which image_transport publishes CameraInfo for raw and for compressed images."""
    parts = rgb.split("/")
    return ["/".join([*parts[:-cut], "camera_info"]) for cut in (1, 2)]


def _join(topics: Iterable[str]) -> str:
    return ", ".join(sorted(topics))
