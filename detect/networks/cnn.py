"""The networks that read parameters, on ONNX Runtime: boxes with kinds to primitives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.networks.parameters import PRESETS, Box, Preset, crop, read_outputs
from detect.networks.weights import Weights, WeightsError
from mapping.grid import GridFrame
from prim.shapes import Kind, Primitive


@dataclass(frozen=True)
class Found:
    """A box of a tile with its kind; ``grey`` is the tile's image (TILE, TILE)."""

    grey: NDArray[np.uint8]
    tile: GridFrame
    box: Box
    kind: Kind


class Estimator:
    """One network for each kind, or one for several.

    Raises WeightsError where a network does not take the crops of its card, or gives other numbers than it says.
    """

    def __init__(self, networks: Sequence[Weights]) -> None:
        self._networks = [_Network(weights) for weights in networks]
        self._of = {kind: network for network in self._networks for kind in network.kinds}

    def crop(self, found: Found) -> NDArray[np.uint8]:
        """What the kind's network sees (pixels, pixels)."""
        return crop(found.grey, found.box, self._of[found.kind].preset)

    def __call__(self, found: Sequence[Found]) -> list[Primitive]:
        """The primitives in boxes, in their order."""
        primitives: dict[int, Primitive] = {}
        for network in self._networks:
            chosen = [i for i, one in enumerate(found) if self._of[one.kind] is network]
            if not chosen:
                continue
            outputs = network.run(np.stack([self.crop(found[i]) for i in chosen]))
            if not np.isfinite(outputs).all():
                raise WeightsError(f"{network.weights.path} gives no numbers for a crop: make it anew")
            for i, row in zip(chosen, outputs.tolist(), strict=True):
                one = found[i]
                own = row[network.preset.span(network.kinds, one.kind)]
                primitives[i] = read_outputs(one.kind, own, network.preset, one.box, one.tile)
        return [primitives[i] for i in range(len(found))]


class _Network:
    """One network with what its card says of it."""

    def __init__(self, weights: Weights) -> None:
        self.weights = weights
        if weights.card.preset not in PRESETS:
            raise WeightsError(f"{weights.path} has a card with an unknown preset {weights.card.preset!r}")
        self.preset: Preset = PRESETS[weights.card.preset]
        self.kinds = [Kind(kind) for kind in weights.card.kinds]
        self._input = weights.session.get_inputs()[0].name
        outputs = self.run(np.zeros((1, self.preset.pixels, self.preset.pixels), np.uint8)).shape[-1]
        wanted = sum(self.preset.outputs(kind) for kind in self.kinds)
        if outputs != wanted:
            raise WeightsError(f"{weights.path} gives {outputs} numbers where its card says {wanted}")

    def run(self, crops: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Outputs (N, M) of crops (N, pixels, pixels)."""
        scaled = crops.astype(np.float32)[:, None] / np.float32(255)
        images = np.repeat(scaled, self.weights.card.channels, axis=1)
        try:
            return np.asarray(self.weights.session.run(None, {self._input: images})[0], dtype=np.float32)
        except Exception as error:  # ONNX Runtime raises many kinds, none of them documented
            raise WeightsError(f"{self.weights.path} does not take crops as its card says") from error
