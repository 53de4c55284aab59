"""The 80 classes of COCO (Lin et al., ECCV 2014), in the order in which detection networks number them."""

from __future__ import annotations

COCO_NAMES: tuple[str, ...] = (
    *("person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light"),
    *("fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow"),
    *("elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee"),
    *("skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard"),
    *("tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple"),
    *("sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch"),
    *("potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard"),
    *("cell phone", "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors"),
    *("teddy bear", "hair drier", "toothbrush"),
)
"""Name of each class index."""

PERSON = COCO_NAMES.index("person")
"""The class that the paper sets aside as potentially moving (Sec. III-A)."""

UNLABELLED = -1
"""What moves and has no class: the network missed it, or has no name for it."""

LIVING = frozenset({PERSON, *range(COCO_NAMES.index("bird"), COCO_NAMES.index("giraffe") + 1)})
"""Classes that deform by themselves: people and animals. Things are rigid: they move as a whole or not at all."""

THINGS = frozenset(range(len(COCO_NAMES))) - LIVING
"""All others. What has no name is in neither: it may be somebody."""


def class_name(label: int) -> str:
    """Name of a class index, also of `UNLABELLED`."""
    return "unnamed" if label == UNLABELLED else COCO_NAMES[label]
