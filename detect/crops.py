"""Crops of a set's primitives with their parameters: what the networks of detect.networks learn from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detect.dataset import Sample, box_of
from detect.parameters import Box, Preset, crop, targets
from prim.shapes import Kind, Primitive

JITTER = 0.06
"""While training, a box's sides are moved by up to this share of its size, as a detector's are."""


@dataclass(frozen=True)
class Crops:
    """All primitives of one kind in a set: ``images`` are the tiles' grey images, ``items`` index them."""

    kind: Kind
    images: tuple[NDArray[np.uint8], ...]
    items: tuple[tuple[int, Box, Primitive], ...]
    resolution: float

    def __len__(self) -> int:
        return len(self.items)

    def exact(self, index: int, preset: Preset) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Crop (pixels, pixels) and targets of one primitive, at its true box."""
        image, box, primitive = self.items[index]
        return crop(self.images[image], box, preset), targets(primitive, preset)

    def varied(
        self, index: int, preset: Preset, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """As :meth:`exact`, with the box jittered, and all of it mirrored and turned by quarters at random."""
        which, box, primitive = self.items[index]
        made = crop(self.images[which], jittered(box, rng), preset)
        if rng.random() < 0.5:
            made, primitive = made[:, ::-1], mirrored(primitive)
        quarters = int(rng.integers(4))
        return np.ascontiguousarray(np.rot90(made, -quarters)), targets(turned(primitive, quarters), preset)


def gather(samples: Sequence[Sample], kind: Kind) -> Crops:
    """All of a set's primitives of one kind."""
    from PIL import Image

    images: list[NDArray[np.uint8]] = []
    items: list[tuple[int, Box, Primitive]] = []
    for sample in samples:
        held = [primitive for primitive in sample.primitives if primitive.kind is kind]
        if held:
            items += [(len(images), box_of(primitive, sample.frame), primitive) for primitive in held]
            images.append(np.asarray(Image.open(sample.image))[..., 0])
    resolution = samples[0].frame.resolution if samples else 0.01
    return Crops(kind, tuple(images), tuple(items), resolution)


def jittered(box: Box, rng: np.random.Generator) -> Box:
    """A box whose sides have been moved at random."""
    left, top, right, bottom = box
    dx, dy = JITTER * (right - left), JITTER * (bottom - top)
    moves = rng.uniform(-1, 1, 4) * (dx, dy, dx, dy)
    return left + moves[0], top + moves[1], right + moves[2], bottom + moves[3]


def mirrored(primitive: Primitive) -> Primitive:
    """A primitive in a world whose x is turned over; its place is left as it is."""
    if primitive.theta is None:
        return primitive
    # the local x axis turns to pi - theta; a triangle's apex must stay on local +y, which takes half a turn more
    theta = -primitive.theta if primitive.kind is Kind.TRIANGLE else math.pi - primitive.theta
    return replace(primitive, theta=theta).canonical()


def turned(primitive: Primitive, quarters: int) -> Primitive:
    """A primitive turned by quarters, counter-clockwise in the map's frame; its place is left as it is."""
    if primitive.theta is None:
        return primitive
    return replace(primitive, theta=primitive.theta + quarters * math.pi / 2).canonical()
