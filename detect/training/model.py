"""The networks that read a primitive's parameters from a crop (the paper's Fig. 3), in torch: for training only.

What the figure shows: three convolutions of 128 filters at 50, 25 and 12 pixels, each followed by batch
normalisation and a max-pool by two (so that 6 x 6 is left), then fully connected layers with fewer and fewer neurons,
all with ReLU, then a layer with as many outputs as the kind has parameters. What it leaves open, and what is chosen
here: kernels are 3 x 3 with padding, as the sizes ask for; a ReLU follows each normalisation; there are two fully
connected layers, of 256 and 64 neurons; the outputs have no activation. One grey channel is what the paper names as
future work; three, as it had, are an option.

The paper trains one such network for each kind. Ours is one for all kinds: what it sees of edges and corners is
shared, each kind has its own outputs, and it is a fifth of the size and of the time.
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
class Shape:
    """A network's widths: ``filters`` of the convolutions, ``neurons`` of the fully connected layers."""

    filters: tuple[int, ...]
    neurons: tuple[int, ...]


SHAPES = {PAPER.name: Shape((128, 128, 128), (256, 64)), PRIM.name: Shape((32, 64, 96, 128), (256, 128))}
"""The paper's network, and one with thinner layers and one more of them, for larger crops."""


class ParameterNetwork(nn.Module):
    """Crops (N, channels, pixels, pixels) float32 in 0 to 1 to outputs (N, M): each kind's, one after the other."""

    def __init__(self, kinds: Sequence[Kind], preset: Preset, channels: int = 1) -> None:
        super().__init__()
        self.kinds, self.preset, self.channels = tuple(kinds), preset, channels
        shape = SHAPES[preset.name]
        blocks: list[Any] = []
        side, before = preset.pixels, channels
        for filters in shape.filters:
            blocks += [nn.Conv2d(before, filters, 3, padding=1), nn.BatchNorm2d(filters), nn.ReLU(), nn.MaxPool2d(2)]
            side, before = side // 2, filters
        self.features = nn.Sequential(*blocks, nn.Flatten())
        layers: list[Any] = []
        width = before * side * side
        for neurons in shape.neurons:
            layers += [nn.Linear(width, neurons), nn.ReLU()]
            width = neurons
        outputs = sum(preset.outputs(kind) for kind in self.kinds)
        self.head = nn.Sequential(*layers, nn.Linear(width, outputs))

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.parameters()).device

    def forward(self, crops: torch.Tensor) -> torch.Tensor:
        """The outputs."""
        return self.head(self.features(crops))
