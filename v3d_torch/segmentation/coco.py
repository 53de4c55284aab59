"""The 80 classes of COCO (Lin et al., ECCV 2014), in the order used by detection networks."""

from __future__ import annotations

COCO_NAMES: tuple[str, ...] = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow",
    "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee",
    "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard",
    "tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple",
    "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch",
    "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard",
    "cell phone", "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
"""Class names by class index."""

PERSON = COCO_NAMES.index("person")
"""Class index of people, the class that the paper treats as potentially moving (Sec. III-A)."""

UNLABELLED = -1
"""Label of moving objects without a class: the network missed them, or was not trained on their class."""

LABELS = range(UNLABELLED, len(COCO_NAMES))
"""Labels of instances: `UNLABELLED` and the class indices."""

LIVING = frozenset({PERSON, *range(COCO_NAMES.index("bird"), COCO_NAMES.index("giraffe") + 1)})
"""Class indices of people and animals, which deform by themselves."""

RIGID = frozenset(range(len(COCO_NAMES))) - LIVING
"""Class indices of all other objects, which are rigid: they move as a whole or not at all. `UNLABELLED` is in neither
set, because an unlabelled object can be a person."""


def class_name(label: int) -> str:
    """Name of a class index or of `UNLABELLED`."""
    return "unlabelled" if label == UNLABELLED else COCO_NAMES[label]
