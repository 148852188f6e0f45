"""Crops that the parameter networks read, and the encoding of a primitive's parameters in their outputs.

There are two presets:

- ``paper`` (III-C): the box is cut out and centred on an empty canvas of 200 x 200 cells, which is downsampled to
  50 x 50; the outputs are the parameters themselves, and the primitive is centred on its box.
- ``prim``: a window of 72 x 72 cells around the box's centre, at the map's resolution, with the surroundings of the
  primitive; the angle is encoded as cosine and sine of the symmetry order times the angle, which is continuous where
  the angle wraps around; two more outputs are the offset of the centroid from the window's centre.
  A triangle's angle would still be discontinuous where it is equilateral and any corner may be the apex. Its corners
  are encoded as the coefficients p and q of the polynomial z³ + p z + q whose roots they are (complex numbers
  relative to the centroid): elementary symmetric functions, which do not depend on the corners' order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.networks.tiles import Box
from mapping.grid import UNKNOWN_GREY, GridFrame
from prim.shapes import Kind, Primitive

LENGTH_UNIT = 0.4
"""Unit (m) of outputs that are lengths, which fits the recorder's sizes into 0 to 1; the shipped networks have it."""

MIN_SIZE = 0.001
"""Smallest size (m) that outputs are decoded to."""


def symmetry_order(kind: Kind) -> int | None:
    """Return the order of a kind's rotational symmetry; None where it has no angle."""
    period = kind.row.period
    return None if period is None else round(2 * math.pi / period)


@dataclass(frozen=True)
class Preset:
    """A way to make crops and to encode parameters.

    Attributes:
        name: Its name in PRESETS and in model cards.
        window: Side (cells) of the window around the box's centre.
        pixels: Side (pixels) that the window is downsampled to, each the mean of a block of cells.
        isolated: Whether all but the box and a rim of one cell around it is blanked out as unknown.
        angle_as_vector: Whether the angle is encoded as cosine and sine.
        has_offset: Whether the centroid's offset from the window's centre is encoded.
    """

    name: str
    window: int
    pixels: int
    isolated: bool
    angle_as_vector: bool
    has_offset: bool

    def encodes_corners(self, kind: Kind) -> bool:
        """Return whether angle and sizes are encoded by the polynomial of the corners: an isosceles triangle's."""
        return self.angle_as_vector and kind.any_apex

    def angle_outputs(self, kind: Kind) -> int:
        """Return how many of a kind's outputs encode its angle: they come first."""
        return 0 if not kind.has_angle else 2 if self.angle_as_vector else 1

    def first_length(self, kind: Kind) -> int:
        """Return the index of a kind's first output in units of LENGTH_UNIT; those before it encode the angle."""
        return 0 if self.encodes_corners(kind) else self.angle_outputs(kind)

    def output_count(self, kind: Kind) -> int:
        """Return how many outputs encode a kind's parameters: angle, offset, sizes, in this order."""
        return self.angle_outputs(kind) + 2 * self.has_offset + len(kind.sizes)

    def output_slice(self, kinds: Sequence[Kind], kind: Kind) -> slice:
        """Return which outputs of a network encode one kind.

        Args:
            kinds: All kinds of the network, in the order of its outputs.
            kind: One of them.

        Returns:
            The slice of the outputs.
        """
        first = sum(self.output_count(other) for other in kinds[: kinds.index(kind)])
        return slice(first, first + self.output_count(kind))

    def window_origin(self, box: Box) -> tuple[int, int]:
        """Return column and row of the first cell of the window around a box."""
        x0, y0, x1, y1 = box
        return round((x0 + x1 - self.window) / 2), round((y0 + y1 - self.window) / 2)

    def window_centre(self, box: Box, tile: GridFrame) -> tuple[float, float]:
        """Return the centre of the window around a box.

        Args:
            box: The box, in cells of the tile.
            tile: The tile's frame.

        Returns:
            x and y (m), map frame.
        """
        col, row = self.window_origin(box)
        half = self.window / 2
        return (tile.col + col + half) * tile.resolution, (tile.row + row + half) * tile.resolution


PAPER = Preset("paper", 200, 50, isolated=True, angle_as_vector=False, has_offset=False)
PRIM = Preset("prim", 72, 72, isolated=False, angle_as_vector=True, has_offset=True)
PRESETS = {preset.name: preset for preset in (PAPER, PRIM)}


def crop_box(image: NDArray[np.uint8], box: Box, preset: Preset) -> NDArray[np.uint8]:
    """Crop an image to the window around a box.

    Args:
        image: First channel (rows, cols) of a tile's image; cells beyond it are unknown.
        box: The box, in cells of the tile.
        preset: Size of the window and of the crop.

    Returns:
        The crop (pixels, pixels).
    """
    if preset.isolated:
        x0, y0, x1, y1 = box
        rows, cols = (slice(max(math.floor(a) - 1, 0), max(math.ceil(b) + 1, 0)) for a, b in ((y0, y1), (x0, x1)))
        own = np.full_like(image, UNKNOWN_GREY)
        own[rows, cols] = image[rows, cols]
        image = own
    col, row = preset.window_origin(box)
    shift, size = np.array([[1.0, 0.0, -col], [0.0, 1.0, -row]]), (preset.window, preset.window)
    window = cv2.warpAffine(
        image, shift, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(UNKNOWN_GREY,)
    )
    crop = cv2.resize(window, (preset.pixels, preset.pixels), interpolation=cv2.INTER_AREA)
    return np.asarray(crop, dtype=np.uint8)


def encode_triangle(primitive: Primitive) -> list[float]:
    """Return real and imaginary part of p / |q|^(1/3), then of q / |q|^(2/3) (m), of the corners' polynomial."""
    corners = primitive.outline() - (primitive.x, primitive.y)
    z = corners[:, 0] + 1j * corners[:, 1]
    p, q = -(z**2).sum() / 2, -(z**3).sum() / 3
    scale = abs(q) ** (1 / 3)
    return [float(part) for value in (p / scale, q / scale**2) for part in (value.real, value.imag)]


def decode_triangle(outputs: Sequence[float]) -> tuple[float, list[float]]:
    """Return angle (rad), base and height (m) of the isosceles triangle that :func:`encode_triangle` encodes.

    The apex is the root whose distances to the other two differ least.
    """
    q = complex(outputs[2], outputs[3])
    scale = abs(q)
    z = np.roots([1.0, 0.0, complex(outputs[0], outputs[1]) * scale, q * scale**2])
    leg_differences = [abs(abs(z[k] - z[k - 1]) - abs(z[k] - z[k - 2])) for k in range(3)]
    apex = int(np.argmin(leg_differences))
    left, right = z[apex - 1], z[apex - 2]
    up = z[apex] - (left + right) / 2
    return math.atan2(up.imag, up.real) - math.pi / 2, [float(abs(left - right)), float(abs(up))]


def encode_parameters(primitive: Primitive, preset: Preset) -> NDArray[np.float32]:
    """Encode a primitive: the training targets of a network.

    Args:
        primitive: The primitive, its centroid relative to the centre of its crop's window (m).
        preset: The encoding.

    Returns:
        The outputs (M,) that a network should give.
    """
    values: list[float] = []
    order = symmetry_order(primitive.kind)
    sizes = [size / LENGTH_UNIT for size in primitive.size]
    if preset.encodes_corners(primitive.kind):
        coefficients = [value / LENGTH_UNIT for value in encode_triangle(primitive)]
        values, sizes = coefficients[:2], coefficients[2:]
    elif order is not None:
        theta = primitive.theta or 0.0
        period = 2 * math.pi / order
        vector = [math.cos(order * theta), math.sin(order * theta)]
        values = vector if preset.angle_as_vector else [theta % period / period]
    if preset.has_offset:
        values += [primitive.x / LENGTH_UNIT, primitive.y / LENGTH_UNIT]
    return np.array([*values, *sizes], dtype=np.float32)


def decode_parameters(kind: Kind, outputs: Sequence[float], preset: Preset, box: Box, tile: GridFrame) -> Primitive:
    """Decode a kind's outputs.

    Without an encoded offset the outline's bounding box is centred on ``box``; a triangle's centroid is not there.

    Args:
        kind: The kind.
        outputs: Its outputs (M,).
        preset: The encoding.
        box: The box, in cells of the tile.
        tile: The tile's frame.

    Returns:
        The primitive in the map frame, its sizes at least MIN_SIZE.
    """
    first = preset.angle_outputs(kind)
    order = symmetry_order(kind)
    theta = None
    sizes = [float(value) * LENGTH_UNIT for value in outputs[preset.output_count(kind) - len(kind.sizes) :]]
    if preset.encodes_corners(kind):
        theta, sizes = decode_triangle([*(float(value) * LENGTH_UNIT for value in outputs[:2]), *sizes])
    elif order is not None:
        period = 2 * math.pi / order
        theta = math.atan2(outputs[1], outputs[0]) / order if preset.angle_as_vector else outputs[0] * period
    size = tuple(max(value, MIN_SIZE) for value in sizes)
    if preset.has_offset:
        x, y = preset.window_centre(box, tile)
        x, y = x + outputs[first] * LENGTH_UNIT, y + outputs[first + 1] * LENGTH_UNIT
        return Primitive(kind, float(x), float(y), theta, size).canonical()
    x0, y0, x1, y1 = box
    x, y = (tile.col + (x0 + x1) / 2) * tile.resolution, (tile.row + (y0 + y1) / 2) * tile.resolution
    at_origin = Primitive(kind, 0.0, 0.0, theta, size).canonical()
    outline = at_origin.outline()
    centre = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return replace(at_origin, x=float(x - centre[0]), y=float(y - centre[1]))
