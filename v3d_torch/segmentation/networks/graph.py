"""A network as a table of layers, each with the layers that feed it, as the YOLO family is published."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

Sources = tuple[int, ...]
"""Indices of the layers whose outputs a layer takes as a list, -1 for the one before; () for just the one before."""


class LayerGraph(nn.Module):
    """Layers run in order; the last one's output is the network's.

    Args:
        layers: the sources of each layer and the layer.
    """

    def __init__(self, layers: list[tuple[Sources, nn.Module]]) -> None:
        super().__init__()
        self.sources = [sources for sources, _ in layers]
        self.model = nn.ModuleList([layer for _, layer in layers])

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Run the network.

        Args:
            image: RGB in [0, 1], shape :math:`(B, 3, H, W)`, H and W multiples of 32.

        Returns:
            What the head gives: predictions :math:`(B, 116, N)` and prototypes :math:`(B, 32, H/4, W/4)`.
        """
        outputs: list[Any] = []
        x: Any = image
        for sources, layer in zip(self.sources, self.model, strict=True):
            x = layer([outputs[index] for index in sources] if sources else x)
            outputs.append(x)
        return x
