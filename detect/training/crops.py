"""Crops of a set's primitives with their parameters: what the networks of detect.training.model learn from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detect.networks.parameters import Box, Preset, crop
from detect.training.dataset import Sample, box_of
from mapping.grid import GridFrame
from prim.shapes import Kind, Primitive

JITTER = 0.06
"""While training, a box's sides are moved by up to this share of its size, as a detector's are."""


@dataclass(frozen=True)
class Crops:
    """All primitives of some kinds in a set: ``images`` are the tiles' grey images, ``items`` index them."""

    images: tuple[NDArray[np.uint8], ...]
    items: tuple[tuple[int, GridFrame, Primitive], ...]

    def __len__(self) -> int:
        return len(self.items)

    def exact(self, index: int, preset: Preset) -> tuple[NDArray[np.uint8], Primitive]:
        """Crop (pixels, pixels) at a primitive's true box, and the primitive as seen from the crop's middle (m)."""
        image, tile, primitive = self.items[index]
        return self._made(image, tile, primitive, box_of(primitive, tile), preset)

    def varied(self, index: int, preset: Preset, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Primitive]:
        """As :meth:`exact`, with the box jittered, and all of it mirrored and turned by quarters at random."""
        image, tile, primitive = self.items[index]
        made, seen = self._made(image, tile, primitive, jittered(box_of(primitive, tile), rng), preset)
        if rng.random() < 0.5:
            made, seen = made[:, ::-1], mirrored(seen)
        quarters = int(rng.integers(4))
        return np.ascontiguousarray(np.rot90(made, -quarters)), turned(seen, quarters)

    def _made(
        self, image: int, tile: GridFrame, primitive: Primitive, box: Box, preset: Preset
    ) -> tuple[NDArray[np.uint8], Primitive]:
        x, y = preset.centre(box, tile)
        return crop(self.images[image], box, preset), replace(primitive, x=primitive.x - x, y=primitive.y - y)


def gather(samples: Sequence[Sample], kinds: Sequence[Kind]) -> Crops:
    """All of a set's primitives of some kinds."""
    from PIL import Image

    images: list[NDArray[np.uint8]] = []
    items: list[tuple[int, GridFrame, Primitive]] = []
    for sample in samples:
        held = [primitive for primitive in sample.primitives if primitive.kind in kinds]
        if held:
            items += [(len(images), sample.frame, primitive) for primitive in held]
            images.append(np.ascontiguousarray(np.asarray(Image.open(sample.image))[..., 0]))
    return Crops(tuple(images), tuple(items))


def jittered(box: Box, rng: np.random.Generator) -> Box:
    """A box whose sides have been moved at random."""
    left, top, right, bottom = box
    dx, dy = JITTER * (right - left), JITTER * (bottom - top)
    moves = rng.uniform(-1, 1, 4) * (dx, dy, dx, dy)
    return left + moves[0], top + moves[1], right + moves[2], bottom + moves[3]


def mirrored(primitive: Primitive) -> Primitive:
    """A primitive in a world whose x is turned over."""
    theta = primitive.theta
    if theta is not None:
        theta = -theta  # every unit outline is its own mirror image about the local y axis
    return replace(primitive, x=-primitive.x, theta=theta).canonical()


def turned(primitive: Primitive, quarters: int) -> Primitive:
    """A primitive in a world that is turned by quarters, counter-clockwise, about the origin."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    x, y = cos * primitive.x - sin * primitive.y, sin * primitive.x + cos * primitive.y
    theta = None if primitive.theta is None else primitive.theta + quarters * math.pi / 2
    return replace(primitive, x=x, y=y, theta=theta).canonical()
