"""Network defined by a table of layers and their inputs, the form in which the YOLO family is published."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

Sources = tuple[int, ...]
"""Indices of the layers whose outputs are the input list of a layer, -1 for the previous layer; () if the input is the
output of the previous layer alone, without a list."""


class LayerGraph(nn.Module):
    """Layers that run in order; the last layer is the head, and its output is the output of the network.

    Args:
        layers: Sources and module of each layer.
    """

    def __init__(self, layers: list[tuple[Sources, nn.Module]]) -> None:
        super().__init__()
        self.sources = [sources for sources, _ in layers]
        self.model = nn.ModuleList([layer for _, layer in layers])

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Run the network.

        Args:
            image: Colour images, RGB in [0, 1], shape :math:`(B, 3, H, W)`, H and W multiples of 32.

        Returns:
            Output of the head: predictions, shape :math:`(B, 116, N)`, and prototypes, shape
            :math:`(B, 32, H/4, W/4)`; see `Segment`.
        """
        predictions, prototypes = self.model[-1](self.pyramid(image))
        return predictions, prototypes

    def pyramid(self, image: Tensor) -> list[Tensor]:
        """Run all layers except the head; returns the feature maps that are its input, finest first."""
        outputs: list[Any] = []
        x: Any = image
        for sources, layer in zip(self.sources[:-1], self.model[:-1], strict=True):
            x = layer([outputs[index] for index in sources] if sources else x)
            outputs.append(x)
        return [outputs[index] for index in self.sources[-1]]
