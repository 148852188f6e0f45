"""From a box to a primitive's parameters: the crop that a network sees, and what its outputs mean.

Two ways of doing it, one for each preset:

- ``paper`` (III-C): the box is cut out and put in the middle of an empty canvas of 200 x 200 cells, which is shrunk
  to 50 x 50; the outputs are the parameters themselves, and the primitive lies where its box does.
- ``prim``: a window of 72 x 72 cells around the box's centre, at the map's own resolution, with what lies around the
  primitive left in; an angle is two outputs, the cosine and the sine of the angle times the kind's symmetry, so that
  no angle is torn apart where it wraps around; two more say how far the centroid lies from the window's middle.
  A triangle's angle would be torn apart where it is equilateral and any corner may be the apex. Its corners are the
  roots of z³ + p z + q (complex numbers around the centroid, in any order): p and q are its outputs, as lengths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapping.grid import UNKNOWN_GREY, GridFrame
from prim.shapes import Kind, Primitive

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in cells of a tile; row 0 at the top."""

LONGEST = 0.4
"""Sizes (m) are outputs in units of this."""


def repeats(kind: Kind) -> int | None:
    """How many times a kind looks the same in one turn; None where it has no angle."""
    period = kind.row.period
    return None if period is None else round(2 * math.pi / period)


def by_corners(kind: Kind, preset: Preset) -> bool:
    """Whether a kind's angle and sizes are told by the polynomial of its corners: where it has three."""
    return preset.vector and kind.corners == 3


@dataclass(frozen=True)
class Preset:
    """How crops are made and outputs are read.

    ``window`` cells around the box's centre become ``pixels`` x ``pixels``; ``isolated`` leaves only the box in it;
    ``vector`` makes two outputs of an angle; ``offset`` adds two outputs for where the centroid lies.
    """

    name: str
    window: int
    pixels: int
    isolated: bool
    vector: bool
    offset: bool

    def angles(self, kind: Kind) -> int:
        """How many of a kind's outputs tell its angle: they come first."""
        return 0 if not kind.has_angle else 2 if self.vector else 1

    def lengths(self, kind: Kind) -> int:
        """The first of a kind's outputs that are lengths; those before it are a cosine and a sine, or a share."""
        return 0 if by_corners(kind, self) else self.angles(kind)

    def outputs(self, kind: Kind) -> int:
        """How many numbers tell a kind's parameters: angle, offset, sizes."""
        return self.angles(kind) + 2 * self.offset + len(kind.sizes)

    def span(self, kinds: Sequence[Kind], kind: Kind) -> slice:
        """Which outputs of a network for several ``kinds`` are one kind's."""
        first = sum(self.outputs(other) for other in kinds[: kinds.index(kind)])
        return slice(first, first + self.outputs(kind))

    def corner(self, box: Box) -> tuple[int, int]:
        """Column and row of the first cell of the window around a box."""
        left, top, right, bottom = box
        return round((left + right - self.window) / 2), round((top + bottom - self.window) / 2)

    def centre(self, box: Box, tile: GridFrame) -> tuple[float, float]:
        """Where (m) the middle of the window around a box of a tile lies."""
        col, row = self.corner(box)
        half = self.window / 2
        return (tile.col + col + half) * tile.resolution, (tile.row + row + half) * tile.resolution


PAPER = Preset("paper", 200, 50, isolated=True, vector=False, offset=False)
PRIM = Preset("prim", 72, 72, isolated=False, vector=True, offset=True)
PRESETS = {preset.name: preset for preset in (PAPER, PRIM)}


def crop(image: NDArray[np.uint8], box: Box, preset: Preset) -> NDArray[np.uint8]:
    """The part (pixels, pixels) of a grey image (rows, cols) that a network sees; unknown beyond the image."""
    rows, cols = image.shape
    left, top, right, bottom = box
    col, row = preset.corner(box)
    window = np.full((preset.window, preset.window), UNKNOWN_GREY, np.uint8)
    first_col, last_col, first_row, last_row = col, col + preset.window, row, row + preset.window
    if preset.isolated:
        first_col, last_col = max(first_col, math.floor(left) - 1), min(last_col, math.ceil(right) + 1)
        first_row, last_row = max(first_row, math.floor(top) - 1), min(last_row, math.ceil(bottom) + 1)
    first_col, last_col = max(first_col, 0), min(last_col, cols)
    first_row, last_row = max(first_row, 0), min(last_row, rows)
    if first_col < last_col and first_row < last_row:
        part = image[first_row:last_row, first_col:last_col]
        window[first_row - row : last_row - row, first_col - col : last_col - col] = part
    return shrink(window, preset.pixels)


def shrink(window: NDArray[np.uint8], pixels: int) -> NDArray[np.uint8]:
    """A square image made smaller by a whole factor: each pixel is the mean of the cells in it."""
    factor = len(window) // pixels
    if factor == 1:
        return window
    blocks = window.reshape(pixels, factor, pixels, factor).astype(np.float32)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), dtype=np.uint8)


def triangle_outputs(primitive: Primitive) -> list[float]:
    """The coefficients p / |q|^(1/3) and q / |q|^(2/3) (m, complex) of the polynomial whose roots are the corners."""
    corners = primitive.outline() - (primitive.x, primitive.y)
    z = corners[:, 0] + 1j * corners[:, 1]
    p, q = -(z**2).sum() / 2, -(z**3).sum() / 3
    scale = abs(q) ** (1 / 3)
    return [float(value) for one in (p / scale, q / scale**2) for value in (one.real, one.imag)]


def read_triangle(outputs: Sequence[float]) -> tuple[float, list[float]]:
    """Angle (rad), base and height (m) of the isosceles triangle that :func:`triangle_outputs` tell.

    The apex is the corner whose sides are most alike.
    """
    q = complex(outputs[2], outputs[3])
    scale = abs(q)
    z = np.roots([1.0, 0.0, complex(outputs[0], outputs[1]) * scale, q * scale**2])
    unlike = [abs(abs(z[k] - z[k - 1]) - abs(z[k] - z[k - 2])) for k in range(3)]
    apex = int(np.argmin(unlike))
    left, right = z[apex - 1], z[apex - 2]
    up = z[apex] - (left + right) / 2
    return math.atan2(up.imag, up.real) - math.pi / 2, [float(abs(left - right)), float(abs(up))]


def targets(primitive: Primitive, preset: Preset) -> NDArray[np.float32]:
    """What a network should give for a primitive, whose place (m) is given from the middle of its crop's window."""
    values: list[float] = []
    turns = repeats(primitive.kind)
    sizes = [size / LONGEST for size in primitive.size]
    if by_corners(primitive.kind, preset):
        told = [value / LONGEST for value in triangle_outputs(primitive)]
        values, sizes = told[:2], told[2:]
    elif turns is not None:
        theta = primitive.theta or 0.0
        period = 2 * math.pi / turns
        values = [math.cos(turns * theta), math.sin(turns * theta)] if preset.vector else [theta % period / period]
    if preset.offset:
        values += [primitive.x / LONGEST, primitive.y / LONGEST]
    return np.array([*values, *sizes], dtype=np.float32)


def read_outputs(kind: Kind, outputs: Sequence[float], preset: Preset, box: Box, tile: GridFrame) -> Primitive:
    """The primitive in a box of a tile that a kind's outputs tell; sizes are a millimetre at least.

    Where the outputs tell no offset, its outline's box has its middle where ``box`` has it: a triangle's centroid,
    for one, is not there.
    """
    first = preset.angles(kind)
    turns = repeats(kind)
    theta = None
    sizes = [float(value) * LONGEST for value in outputs[preset.outputs(kind) - len(kind.sizes) :]]
    if by_corners(kind, preset):
        theta, sizes = read_triangle([*(float(value) * LONGEST for value in outputs[:2]), *sizes])
    elif turns is not None:
        period = 2 * math.pi / turns
        theta = math.atan2(outputs[1], outputs[0]) / turns if preset.vector else outputs[0] * period
    size = tuple(max(value, 0.001) for value in sizes)
    if preset.offset:
        x, y = preset.centre(box, tile)
        x, y = x + outputs[first] * LONGEST, y + outputs[first + 1] * LONGEST
        return Primitive(kind, float(x), float(y), theta, size).canonical()
    left, top, right, bottom = box
    x, y = (tile.col + (left + right) / 2) * tile.resolution, (tile.row + (top + bottom) / 2) * tile.resolution
    at_origin = Primitive(kind, 0.0, 0.0, theta, size).canonical()
    outline = at_origin.outline()
    middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
    return replace(at_origin, x=float(x - middle[0]), y=float(y - middle[1]))
