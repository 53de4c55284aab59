"""The COCO classes."""

from __future__ import annotations

from v3d_torch.segmentation import COCO_NAMES, PERSON


def test_class_names_are_the_80_of_coco_in_network_order() -> None:
    assert len(set(COCO_NAMES)) == 80
    assert PERSON == 0
    assert (COCO_NAMES[15], COCO_NAMES[41], COCO_NAMES[56], COCO_NAMES[79]) == ("cat", "cup", "chair", "toothbrush")
