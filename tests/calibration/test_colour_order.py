"""Order of the colour channels, by a network with known scores."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from helpers.board_room import CAMERA, make_views
from torch import Tensor

from v3d_torch.batch.ablation_study import CachedSegmenter
from v3d_torch.calibration.colour_order import check_colour_order
from v3d_torch.mapping.static_views import StaticViews
from v3d_torch.segmentation import NoSegmentation
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.segmentation.yolo import YOLOSegmenter


class ScoreNetwork(YOLOSegmenter):
    """Network whose scores are higher the more red an image has, relative to blue."""

    def __init__(self, preference: float) -> None:
        self.preference, self.calls = preference, 0

    def segment(self, image: Tensor) -> SimpleNamespace:  # type: ignore[override]
        self.calls += 1
        mean = image.float().mean(dim=(1, 2))
        return SimpleNamespace(scores=torch.stack([1 + self.preference * (mean[0] - mean[2]) / mean.sum()]))


def test_network_that_recognises_more_after_the_exchange_gives_a_warning() -> None:
    views, _ = make_views(6)
    preference = 4.0 if float(check_red(views)) < 0 else -4.0
    (warning,) = check_colour_order(views, UprightSegmenter(ScoreNetwork(preference)))
    assert warning.endswith("the colour images seem to be BGR instead of RGB")
    network = ScoreNetwork(-preference)
    assert check_colour_order(views, network) == [] and network.calls == 4  # two images, given and exchanged


def test_network_inside_of_all_wrappers_is_compared() -> None:
    """As in an ablation study."""
    network = ScoreNetwork(4.0)
    check_colour_order(make_views(6)[0], UprightSegmenter(CachedSegmenter(network)))
    assert network.calls > 0


@pytest.mark.parametrize("count", [0, 1])
def test_few_views_or_no_network_give_no_warning(count: int) -> None:
    assert check_colour_order(make_views(6)[0], NoSegmentation()) == []
    few = StaticViews(CAMERA, 2)
    for view in list(make_views(6)[0])[:count]:
        few.append(view)
    assert check_colour_order(few, ScoreNetwork(4.0)) == []


def check_red(views: object) -> Tensor:
    """Mean of red minus blue of all views."""
    colours = torch.stack([view.colour.float().mean(dim=(1, 2)) for view in views])  # type: ignore[attr-defined]
    return (colours[:, 0] - colours[:, 2]).mean()
