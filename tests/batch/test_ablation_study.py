"""Cache of the instances in an ablation study."""

from __future__ import annotations

import torch
from helpers.differences import differences
from helpers.walk_with_loop import CAMERA, CONFIG, Walk

from v3d_torch.batch.ablation_study import CachedSegmenter
from v3d_torch.config.loading import override_config
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.slam import V3DSLAM
from v3d_torch.types import Instances, RGBDFrame


def test_cached_instances_are_identical_and_independent_copies() -> None:
    generator = torch.Generator().manual_seed(0)
    segmented = []

    def segment(frame: RGBDFrame) -> Instances:
        segmented.append(frame.index)
        count = frame.index  # none in the first frame
        return Instances(
            torch.rand(count, 5, 13, generator=generator) > 0.5,
            torch.arange(count),
            torch.rand(count, generator=generator),
            torch.rand(count, 4, generator=generator),
        )

    originals: dict[int, Instances] = {}

    def segment_and_store(frame: RGBDFrame) -> Instances:
        originals[frame.index] = segment(frame)
        return originals[frame.index]

    cached_segment = CachedSegmenter(segment_and_store)
    frames = [RGBDFrame(k, float(k), torch.zeros(3, 5, 13, dtype=torch.uint8), torch.zeros(1, 5, 13)) for k in range(4)]
    for frame in [*frames, *reversed(frames)]:
        copy, original = cached_segment(frame), originals[frame.index]
        assert copy.masks.dtype == torch.bool
        for name in ("masks", "labels", "scores", "boxes"):
            assert torch.equal(getattr(copy, name), getattr(original, name)), name
        copy.masks.fill_(True)
    assert segmented == [0, 1, 2, 3]


def test_rotated_image_is_segmented_anew() -> None:
    segmented = []

    def segment(frame: RGBDFrame) -> Instances:
        segmented.append(frame.image.shape[1:])
        return Instances.empty(*frame.image.shape[1:])

    cached_segment = CachedSegmenter(segment)
    image = torch.randint(0, 255, (3, 5, 13), generator=torch.Generator().manual_seed(0)).byte()
    for turns in (0, 1, 2, 3, 2, 1, 0):
        turned = torch.rot90(image, turns, dims=(1, 2))
        assert (
            cached_segment(RGBDFrame(0, 0.0, turned, torch.zeros(1, *turned.shape[1:]))).masks.shape[1:]
            == turned.shape[1:]
        )
    assert segmented == [(5, 13), (13, 5), (5, 13), (13, 5)]


def test_baseline_without_masks_is_recognised_inside_of_the_cache() -> None:
    """Nothing is checked against earlier views if there are no objects."""
    walk, config = Walk(), override_config(CONFIG, ["segmentation.source=none"])
    plain, cached = (V3DSLAM(CAMERA, each, config) for each in (NoSegmentation(), CachedSegmenter(NoSegmentation())))
    for index in range(3):
        plain(walk[index]), cached(walk[index])
    states = (slam.free_space_check.state_dict() for slam in (plain, cached))
    assert list(differences(*states, "views", {})) == []
