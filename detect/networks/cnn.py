"""The parameter networks on ONNX Runtime: from classified regions to primitives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.networks.parameters import PRESETS, Preset, crop_box, decode_parameters
from detect.networks.tiles import Box
from detect.networks.weights import BATCHES, Weights, WeightsError
from mapping.grid import GridFrame
from prim.shapes import Kind, Primitive

MAX_OUTPUT = 1000.0
"""Outputs beyond this encode no primitive: lengths of 400 m. Set by hand."""


@dataclass(frozen=True)
class ClassifiedRegion:
    """A classified region of interest: a box of a tile, and the kind of the primitive that it bounds.

    Attributes:
        grey: First channel (TILE_SIZE, TILE_SIZE) of the tile's image.
        tile: The tile's frame.
        box: The box, in cells of the tile.
        kind: The kind.
    """

    grey: NDArray[np.uint8]
    tile: GridFrame
    box: Box
    kind: Kind


class ParameterEstimator:
    """The networks that estimate parameters from crops: one for each kind, or one for several."""

    def __init__(self, networks: Sequence[Weights]) -> None:
        """Check the networks against their model cards.

        Raises:
            WeightsError: A network does not take the crops that its card names, or has another number of outputs.
        """
        self._networks = [_Network(weights) for weights in networks]
        self._network_of = {kind: network for network in self._networks for kind in network.kinds}

    def crop(self, region: ClassifiedRegion) -> NDArray[np.uint8]:
        """Return the input (pixels, pixels) of the kind's network."""
        return crop_box(region.grey, region.box, self._network_of[region.kind].preset)

    def __call__(self, regions: Sequence[ClassifiedRegion]) -> list[Primitive | None]:
        """Estimate the primitives in regions.

        Args:
            regions: The regions.

        Returns:
            The primitives in the order given, map frame; None where a network's outputs are those of none that its
            tile holds.

        Raises:
            WeightsError: A network does not take its crops, or gives outputs that are not finite.
        """
        primitives: dict[int, Primitive | None] = {}
        for network in self._networks:
            chosen = [i for i in range(len(regions)) if self._network_of[regions[i].kind] is network]
            if not chosen:
                continue
            outputs = network.run(np.stack([self.crop(regions[i]) for i in chosen]))
            for i, row in zip(chosen, outputs.tolist(), strict=True):
                own = row[network.preset.output_slice(network.kinds, regions[i].kind)]
                primitives[i] = _decode(regions[i], own, network.preset)
        return [primitives[i] for i in range(len(regions))]


def _decode(region: ClassifiedRegion, outputs: Sequence[float], preset: Preset) -> Primitive | None:
    """Return the primitive that outputs encode; None where it is larger than its tile, or far from it."""
    if max(map(abs, outputs)) > MAX_OUTPUT:
        return None
    tile = region.tile
    primitive = decode_parameters(region.kind, outputs, preset, region.box, tile)
    x, y = (tile.col + tile.cols / 2) * tile.resolution, (tile.row + tile.rows / 2) * tile.resolution
    side = max(tile.rows, tile.cols) * tile.resolution
    fits = primitive.bounding_radius <= side and math.hypot(primitive.x - x, primitive.y - y) <= 2 * side
    return primitive if fits else None


class _Network:
    """One network, checked against its model card."""

    def __init__(self, weights: Weights) -> None:
        self.weights = weights
        self.preset: Preset = PRESETS[str(weights.card.preset)]
        self.kinds = [Kind(kind) for kind in weights.card.kinds]
        self.run(np.zeros((1, self.preset.pixels, self.preset.pixels), np.uint8))

    def run(self, crops: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return outputs (N, M) of crops (N, pixels, pixels)."""
        found = []
        for first in range(0, len(crops), BATCHES["cnn"]):
            scaled = crops[first : first + BATCHES["cnn"]].astype(np.float32)[:, None] / np.float32(255)
            found.append(self.weights.run(np.repeat(scaled, self.weights.card.channels, axis=1)))
        outputs = np.concatenate(found)
        expected = len(crops), sum(self.preset.output_count(kind) for kind in self.kinds)
        if outputs.shape != expected:
            shape, wanted = (" x ".join(map(str, sizes)) for sizes in (outputs.shape, expected))
            raise WeightsError(f"{self.weights.path} gives {shape} numbers where its card says {wanted}")
        return outputs
