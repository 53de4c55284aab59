"""Colour histograms of instances and their similarity."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from v3d_torch.objects.appearance import HISTOGRAM_SIZE, _bins_of_colours, colour_histograms, histogram_similarity

RED, GREEN = torch.tensor([200, 30, 30], dtype=torch.uint8), torch.tensor([30, 160, 40], dtype=torch.uint8)


def halves() -> tuple[torch.Tensor, torch.Tensor]:
    """Return an image (3, 80, 80) that is red on the left and green on the right, and the masks of both halves."""
    left = torch.zeros(80, 80, dtype=torch.bool)
    left[:, :40] = True
    return torch.where(left, RED[:, None, None], GREEN[:, None, None]), torch.stack([left, ~left])


def test_histograms_sum_to_one() -> None:
    histograms = colour_histograms(*halves())
    assert histograms.shape == (2, HISTOGRAM_SIZE)
    torch.testing.assert_close(histograms.sum(dim=1), torch.ones(2))


def test_similarity_is_one_for_equal_colours_and_low_for_others() -> None:
    histograms = colour_histograms(*halves())
    similarity = histogram_similarity(histograms, histograms)
    torch.testing.assert_close(similarity.diag(), torch.ones(2))
    assert float(similarity[0, 1]) < 0.1


def test_slightly_darker_image_is_similar() -> None:
    image, masks = halves()
    darker = (image * 0.9).to(torch.uint8)
    similarity = histogram_similarity(colour_histograms(image, masks), colour_histograms(darker, masks))
    assert float(similarity.diag().min()) > 0.8


def test_noise_of_grey_clothes_hardly_changes_the_histogram() -> None:
    _, masks = halves()
    generator = torch.Generator().manual_seed(0)
    grey, tinted = (
        torch.randint(118, 123, (3, 80, 80), dtype=torch.uint8, generator=generator) + offset[:, None, None]
        for offset in torch.tensor([[0, 0, 0], [3, 0, 0]], dtype=torch.uint8)
    )
    similarity = histogram_similarity(colour_histograms(grey, masks), colour_histograms(tinted, masks))
    assert float(similarity.min()) > 0.99


def test_bins_are_those_of_opencv() -> None:
    image = torch.randint(256, (3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    lab = cv2.cvtColor(image.permute(1, 2, 0).numpy(), cv2.COLOR_RGB2LAB)[::4, ::4].astype(np.float64)
    axes = lab[..., 0] * 8 / 255, (lab[..., 1] - 128) / 10 + 4.5, (lab[..., 2] - 128) / 10 + 4.5
    brightness, a, b = (np.clip(np.floor(axis), 0, 7).astype(np.int64) for axis in axes)
    expected = np.stack([brightness, a, b])
    found = np.stack(np.unravel_index(_bins_of_colours()[tuple(image.numpy()[:, ::4, ::4] // 8)], (8, 8, 8)))
    # All colours of a level have the bin of its middle: a few are in the next bin.
    assert np.abs(found - expected).max() <= 1 and (found == expected).mean() > 0.95


def test_appearance_of_a_few_pixels_is_unknown() -> None:
    image, masks = halves()
    masks[0, 8:] = False
    masks[0, :, 8:] = False
    assert colour_histograms(image, masks)[:, 0].isnan().tolist() == [True, False]


def test_no_instances_have_no_histograms() -> None:
    image, masks = halves()
    assert colour_histograms(image, masks[:0]).shape == (0, HISTOGRAM_SIZE)
