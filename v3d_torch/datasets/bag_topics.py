"""Which topics of a bag are colour, depth and camera: the user's wish, else a guess from types and names."""

from __future__ import annotations

import re
from collections.abc import Mapping
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
_RECTIFIED = re.compile(r"rect", re.IGNORECASE)


@dataclass(frozen=True)
class Topics:
    """Names of a bag's topics.

    Args:
        rgb: colour images.
        depth: depth images.
        info: camera of the colour images; None where none was found.
    """

    rgb: str
    depth: str
    info: str | None

    @property
    def is_rectified(self) -> bool:
        """Whether the colour images say that lens distortion has been taken out of them."""
        return bool(_RECTIFIED.search(self.rgb))

    @property
    def is_registered(self) -> bool:
        """Whether the depth images say that they lie on the colour images, pixel by pixel."""
        return bool(_REGISTERED.search(self.depth))


def choose_topics(
    bag: object, types: Mapping[str, str], rgb: str | None = None, depth: str | None = None, info: str | None = None
) -> Topics:
    """Find the topics of a bag.

    Args:
        bag: for messages.
        types: type of each topic.
        rgb: the user's choice; None guesses, raw images before rectified and compressed ones.
        depth: the user's choice; None guesses, depth registered to colour before other, then the same camera's.
        info: the user's choice; None takes the one beside the colour images.

    Raises:
        InputError: a topic is not there or of another type, none fits, or several fit as well.
    """
    images = {topic: kind for topic, kind in types.items() if kind in (IMAGE, COMPRESSED)}
    if not images:
        raise InputError(f"{bag}: holds no images; record the topics of colour, of depth and of their camera")
    for option, topic in (("rgb", rgb), ("depth", depth)):
        if topic is not None and topic not in images:
            raise InputError(f"{bag}: has no images on {topic}; give --{option}-topic one of {_listed(images)}")
    usable = [topic for topic in images if not _NEITHER.search(topic)]
    if rgb is None:
        others = [topic for topic in usable if not _DEPTH.search(topic) and topic != depth]
        named = [topic for topic in others if _COLOUR.search(topic)]
        ranks = {topic: (bool(_RECTIFIED.search(topic)), _compression(topic, images)) for topic in named or others}
        rgb = _best(bag, "colour", "rgb", ranks, images)
    if depth is None:
        ranks_depth = {
            topic: (not _REGISTERED.search(topic), -_shared(topic, rgb), _compression(topic, images))
            for topic in usable
            if _DEPTH.search(topic) and topic != rgb
        }
        depth = _best(bag, "depth", "depth", ranks_depth, images)
    infos = [topic for topic, kind in types.items() if kind == CAMERA_INFO]
    if info is not None and info not in infos:
        raise InputError(f"{bag}: has no camera on {info}; give --info-topic one of {_listed(infos)}")
    return Topics(rgb, depth, info or next((topic for topic in infos if topic in _beside(rgb)), None))


def _best(bag: object, what: str, option: str, ranks: Mapping[str, tuple[int, ...]], images: Mapping[str, str]) -> str:
    if not ranks:
        raise InputError(
            f"{bag}: no topic has the name of {what} images; give --{option}-topic one of {_listed(images)}"
        )
    best = sorted(topic for topic, rank in ranks.items() if rank == min(ranks.values()))
    if len(best) > 1:
        raise InputError(f"{bag}: has several topics of {what} images; give --{option}-topic one of {', '.join(best)}")
    return best[0]


def _compression(topic: str, images: Mapping[str, str]) -> int:
    """0 for raw images; what is compressed without regard to depth comes last."""
    return 0 if images[topic] == IMAGE else 1 if topic.endswith("compressedDepth") else 2


def _shared(topic: str, other: str) -> int:
    """How many words both names begin with: those of the camera."""
    pairs = zip(topic.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _beside(rgb: str) -> list[str]:
    """Where image_transport publishes the camera of a topic of images, or of the topic that it compresses."""
    parts = rgb.split("/")
    return ["/".join([*parts[:-cut], "camera_info"]) for cut in (1, 2)]


def _listed(topics: Mapping[str, str] | list[str]) -> str:
    return ", ".join(sorted(topics)) or "none: it holds no such topic"
