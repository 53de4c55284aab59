"""Segmenters that use the predicted pose, and the state of segmenters."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch
from helpers.tilted_frames import IDENTITY, Network, make_frame
from torch import nn

from v3d_torch.errors import ConfigError
from v3d_torch.runtime.stateful import Stateful
from v3d_torch.segmentation.segmenter import (
    PoseAwareSegmenter,
    innermost_segmenter,
    restore_segmenter,
    segment_frame,
    segmenter_state_of,
)
from v3d_torch.segmentation.upright import UprightSegmenter
from v3d_torch.types import Instances, RGBDFrame


def test_protocols_and_helper_functions_apply_to_upright_segmenters_only() -> None:
    network = Network()
    upright = UprightSegmenter(network)
    assert isinstance(upright, PoseAwareSegmenter) and isinstance(upright, Stateful)
    assert not isinstance(network, PoseAwareSegmenter) and not isinstance(network, Stateful)
    assert segment_frame(upright, make_frame(0, 1), IDENTITY).labels.tolist() == [0]
    assert segment_frame(network, make_frame(0, 1), IDENTITY).labels.tolist() == [1]
    state = segmenter_state_of(upright)
    assert state is not None and state["calls"] == 1 and segmenter_state_of(network) is None
    other = UprightSegmenter(Network())
    restore_segmenter(other, None)
    assert other.state_dict()["calls"] == 0
    restore_segmenter(other, state)
    restore_segmenter(network, state)
    assert other.state_dict()["calls"] == 1 and torch.equal(other.state_dict()["up"], state["up"])


def test_source_of_instances_is_found_inside_of_wrappers() -> None:
    network = Network()
    assert innermost_segmenter(network) is network
    assert innermost_segmenter(UprightSegmenter(UprightSegmenter(network))) is network


def test_weights_of_a_torch_module_are_not_its_state() -> None:
    class Module(nn.Module):
        def forward(self, frame: RGBDFrame) -> Instances:
            return Instances.empty(*frame.image.shape[1:])

    assert segmenter_state_of(Module()) is None


def test_methods_forwarded_by_a_proxy_are_used() -> None:
    class Proxy:
        def __init__(self, target: object) -> None:
            self._target = target

        def __call__(self, frame: RGBDFrame) -> Instances:
            raise AssertionError("called without the pose")

        def __getattr__(self, name: str) -> object:
            return getattr(self._target, name)

    proxy = Proxy(UprightSegmenter(Network()))
    assert segment_frame(proxy, make_frame(0, 1), IDENTITY).labels.tolist() == [0]
    state = segmenter_state_of(proxy)
    assert state is not None and state["calls"] == 1


class Counter:
    """Segmenter whose state shares a list with it, as the states of the stages do."""

    def __init__(self) -> None:
        self.indices: list[int] = []

    def __call__(self, frame: RGBDFrame) -> Instances:
        self.indices.append(frame.index)
        return Instances.empty(*frame.image.shape[1:])

    def state_dict(self) -> dict[str, list[int]]:
        return {"indices": self.indices}

    def load_state_dict(self, state: Mapping[str, list[int]]) -> None:
        self.indices = state["indices"]


def test_state_does_not_change_when_later_frames_are_segmented() -> None:
    counter, resumed = Counter(), Counter()
    counter(make_frame(0, 0))
    state = segmenter_state_of(counter)
    counter(make_frame(1, 0))
    assert state == {"indices": [0]}
    restore_segmenter(resumed, state)
    resumed(make_frame(1, 0))
    assert state == {"indices": [0]} and resumed.indices == [0, 1]


def test_state_of_another_segmenter_is_an_error_that_names_the_cause() -> None:
    state = segmenter_state_of(UprightSegmenter(Network()))
    message = r"^the segmenter, a Counter, cannot load the saved state \(KeyError: 'indices'\); give the segmenter with"
    with pytest.raises(ConfigError, match=message):
        restore_segmenter(Counter(), state)
