"""Crops of a data set's primitives with their parameters: the samples that parameter networks are trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detect.networks.parameters import Preset, crop_box
from detect.networks.tiles import Box
from detect.training.dataset import Sample, bounding_box, read_image
from mapping.grid import GridFrame
from prim.shapes import Kind, Primitive

JITTER = 0.06
"""Augmentation moves a box's sides by up to this share of its size, as errors of a detector do; set by hand."""


@dataclass(frozen=True)
class CropSamples:
    """All primitives of some kinds in a data set.

    Attributes:
        images: Grey images (TILE_SIZE, TILE_SIZE) of the tiles.
        items: For each primitive the index of its image, the tile's frame, and the primitive in the map frame.
    """

    images: tuple[NDArray[np.uint8], ...]
    items: tuple[tuple[int, GridFrame, Primitive], ...]

    def __len__(self) -> int:
        return len(self.items)

    def plain(self, index: int, preset: Preset) -> tuple[NDArray[np.uint8], Primitive]:
        """Return one sample as it is.

        Args:
            index: Number of the primitive.
            preset: How crops are made.

        Returns:
            The crop (pixels, pixels) at the true box, and the primitive relative to the centre of its window (m).
        """
        image, tile, primitive = self.items[index]
        return self._cropped(image, tile, primitive, bounding_box(primitive, tile), preset)

    def augmented(self, index: int, preset: Preset, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Primitive]:
        """Return one sample with its box jittered, mirrored and rotated by quarter turns at random.

        Args:
            index: Number of the primitive.
            preset: How crops are made.
            rng: Source of randomness.

        Returns:
            As :meth:`plain`.
        """
        image, tile, primitive = self.items[index]
        box = jitter_box(bounding_box(primitive, tile), rng)
        crop, relative = self._cropped(image, tile, primitive, box, preset)
        if rng.random() < 0.5:
            crop, relative = crop[:, ::-1], mirror(relative)
        quarters = int(rng.integers(4))
        return np.ascontiguousarray(np.rot90(crop, -quarters)), rotate_by_quarters(relative, quarters)

    def _cropped(
        self, image: int, tile: GridFrame, primitive: Primitive, box: Box, preset: Preset
    ) -> tuple[NDArray[np.uint8], Primitive]:
        x, y = preset.window_centre(box, tile)
        return crop_box(self.images[image], box, preset), replace(primitive, x=primitive.x - x, y=primitive.y - y)


def collect_crops(samples: Sequence[Sample], kinds: Sequence[Kind]) -> CropSamples:
    """Collect the primitives of some kinds.

    Args:
        samples: Tiles of a data set.
        kinds: The kinds.

    Returns:
        Their crops, in the order of the tiles.
    """
    images: list[NDArray[np.uint8]] = []
    items: list[tuple[int, GridFrame, Primitive]] = []
    for sample in samples:
        chosen = [primitive for primitive in sample.primitives if primitive.kind in kinds]
        if chosen:
            items += [(len(images), sample.frame, primitive) for primitive in chosen]
            images.append(np.ascontiguousarray(read_image(sample)[..., 0]))
    return CropSamples(tuple(images), tuple(items))


def jitter_box(box: Box, rng: np.random.Generator) -> Box:
    """Move each side of a box at random, by up to JITTER of the box's size.

    Args:
        box: The box.
        rng: Source of randomness.

    Returns:
        The jittered box.
    """
    x0, y0, x1, y1 = box
    dx, dy = JITTER * (x1 - x0), JITTER * (y1 - y0)
    moves = rng.uniform(-1, 1, 4) * (dx, dy, dx, dy)
    return x0 + moves[0], y0 + moves[1], x1 + moves[2], y1 + moves[3]


def mirror(primitive: Primitive) -> Primitive:
    """Return the mirror image of a primitive about the y axis."""
    theta = primitive.theta
    if theta is not None:
        theta = -theta  # every unit outline is its own mirror image about the local y axis
    return replace(primitive, x=-primitive.x, theta=theta).canonical()


def rotate_by_quarters(primitive: Primitive, quarters: int) -> Primitive:
    """Rotate a primitive about the origin by quarter turns.

    Args:
        primitive: The primitive.
        quarters: Number of quarter turns, counter-clockwise.

    Returns:
        The rotated primitive.
    """
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    x, y = cos * primitive.x - sin * primitive.y, sin * primitive.x + cos * primitive.y
    theta = None if primitive.theta is None else primitive.theta + quarters * math.pi / 2
    return replace(primitive, x=x, y=y, theta=theta).canonical()
