"""Colour histograms of instances and their similarity."""

from __future__ import annotations

import torch

from v3d_torch.objects.appearance import HISTOGRAM_SIZE, colour_histograms, histogram_similarity

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


def test_appearance_of_a_few_pixels_is_unknown() -> None:
    image, masks = halves()
    masks[0, 8:] = False
    masks[0, :, 8:] = False
    assert colour_histograms(image, masks)[:, 0].isnan().tolist() == [True, False]


def test_no_instances_have_no_histograms() -> None:
    image, masks = halves()
    assert colour_histograms(image, masks[:0]).shape == (0, HISTOGRAM_SIZE)
