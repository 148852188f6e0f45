"""The parameter networks (the paper's Fig. 3) in torch: for training only.

The figure shows three convolutions of 128 filters at 50, 25 and 12 pixels, each followed by batch normalisation and
max pooling by two (which leaves 6 x 6), then fully connected layers of decreasing width, all with ReLU, then a layer
with one output for each parameter. What it leaves open is chosen here: kernels of 3 x 3 with padding, as the sizes
require; a ReLU after each normalisation; two fully connected layers of 256 and 64 neurons; no activation of the
outputs. One grey channel is what the paper names as future work; its three channels are an option.

The paper trains one such network for each kind. The preset ``prim`` has one for all kinds, which shares the features
and has outputs for each kind: a fifth of the size and of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from detect.networks.parameters import PAPER, PRIM, Preset
from prim.shapes import Kind


@dataclass(frozen=True)
class LayerWidths:
    """Widths of a network's layers.

    Attributes:
        filters: Filters of each convolution.
        neurons: Neurons of each fully connected layer but the last.
    """

    filters: tuple[int, ...]
    neurons: tuple[int, ...]


LAYER_WIDTHS = {
    PAPER.name: LayerWidths((128, 128, 128), (256, 64)),
    PRIM.name: LayerWidths((32, 64, 96, 128), (256, 128)),
}
"""The paper's network; and one with narrower layers and one more of them, for larger crops (set by hand)."""


class ParameterNetwork(nn.Module):
    """A network from crops (N, channels, pixels, pixels), float32 in 0 to 1, to outputs (N, M).

    Attributes:
        kinds: The kinds, in the order of the outputs.
        preset: The encoding.
        channels: Channels of the crops.
    """

    def __init__(self, kinds: Sequence[Kind], preset: Preset, channels: int = 1) -> None:
        super().__init__()
        self.kinds, self.preset, self.channels = tuple(kinds), preset, channels
        widths = LAYER_WIDTHS[preset.name]
        blocks: list[Any] = []
        side, before = preset.pixels, channels
        for filters in widths.filters:
            blocks += [nn.Conv2d(before, filters, 3, padding=1), nn.BatchNorm2d(filters), nn.ReLU(), nn.MaxPool2d(2)]
            side, before = side // 2, filters
        self.features = nn.Sequential(*blocks, nn.Flatten())
        layers: list[Any] = []
        width = before * side * side
        for neurons in widths.neurons:
            layers += [nn.Linear(width, neurons), nn.ReLU()]
            width = neurons
        outputs = sum(preset.output_count(kind) for kind in self.kinds)
        self.head = nn.Sequential(*layers, nn.Linear(width, outputs))

    @property
    def device(self) -> torch.device:
        """The device of the weights."""
        return next(self.parameters()).device

    def forward(self, crops: torch.Tensor) -> torch.Tensor:
        """Return the outputs (N, M)."""
        return self.head(self.features(crops))
