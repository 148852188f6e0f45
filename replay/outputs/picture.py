"""A picture of a map and the primitives in it."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.detection import OTHER
from mapping.grid import GridFrame, OccupancyGrid
from prim.arrays import FloatArray
from prim.errors import UsageError
from prim.files import ResultFormat, write_file
from prim.parameters import checked_path, errors_name_parameters
from prim.shapes import Color, Primitive
from replay.outputs.found_objects import OBJECT_COLOR, FoundObject
from replay.outputs.found_primitives import FoundPrimitive

_SOFTWARE = b"tEXtSoftware\0prim"
_PNG_SOFTWARE = struct.pack(">I", len(_SOFTWARE) - 4) + _SOFTWARE + struct.pack(">I", zlib.crc32(_SOFTWARE))
_PNG_HEADER_BYTES = 8 + 25
"""A PNG file begins with its magic and the chunk IHDR."""

PICTURE = ResultFormat("a picture of prim", re.compile(rb"\x89PNG.{33}" + _SOFTWARE, re.DOTALL))

LONGER_SIDE = 1000
"""About how many pixels the longer side of a picture has; set by hand."""

GREY, LABEL_GREY = (130, 130, 130), (90, 90, 90)
FONT = cv2.FONT_HERSHEY_SIMPLEX
FONT_SCALE, TEXT_THICKNESS, OUTLINE_THICKNESS = 0.5, 1, 2
SUBPIXEL_BITS = 4
"""Vertices are drawn at sixteenths of a pixel."""

SCALE_BAR_SHARE = 0.2
"""The scale bar is no longer than this share of the picture's width."""


@dataclass(frozen=True, repr=False)
class Picture:
    """A picture; a notebook shows it by itself.

    Attributes:
        pixels: (rows, columns, 3) red, green, blue.
    """

    pixels: NDArray[np.uint8]

    @property
    def png(self) -> bytes:
        """The picture as a PNG file holds it, with prim named as the software that drew it."""
        content = cv2.imencode(".png", cv2.cvtColor(self.pixels, cv2.COLOR_RGB2BGR))[1].tobytes()
        return content[:_PNG_HEADER_BYTES] + _PNG_SOFTWARE + content[_PNG_HEADER_BYTES:]

    def save(self, path: str | Path, force: bool = False) -> None:
        """Write the picture as PNG.

        Args:
            path: The file.
            force: Whether a file in its place may be replaced that is no earlier picture of prim.

        Raises:
            UsageError: The name does not end in .png, or there is another file in its place.
            OutputError: The file cannot be written.
        """
        if checked_path("path", path).suffix.lower() != ".png":
            raise UsageError(f"{path}: a picture is saved as PNG: give a name that ends in .png")
        with errors_name_parameters((), ("force",)):
            write_file(checked_path("path", path), self.png, PICTURE, force)

    def __repr__(self) -> str:
        rows, cols, _ = self.pixels.shape
        return f"Picture({cols} x {rows} pixels)"

    def _repr_png_(self) -> bytes:
        return self.png


def draw_picture(
    grid: OccupancyGrid,
    primitives: Sequence[FoundPrimitive] = (),
    truth: Sequence[Primitive] = (),
    objects: Sequence[FoundObject] = (),
) -> Picture:
    """Draw a map in greys (occupied black, free white, unknown grey), primitives and objects over it, and a scale.

    Args:
        grid: The map.
        primitives: Drawn in the colours of their kinds, with id and kind.
        truth: Drawn in grey.
        objects: Those of no kind, drawn in a lighter grey, with id.

    Returns:
        The picture; the largest y is at the top.
    """
    rows, cols = grid.frame.shape
    zoom = LONGER_SIDE / max(rows, cols)
    zoom = float(max(1, round(zoom))) if zoom > 1 else zoom
    greys = np.rint(255 * (1 - np.flipud(grid.probability))).astype(np.uint8)
    size = max(1, round(cols * zoom)), max(1, round(rows * zoom))
    interpolation = cv2.INTER_NEAREST if zoom >= 1 else cv2.INTER_AREA
    pixels = cv2.cvtColor(cv2.resize(greys, size, interpolation=interpolation), cv2.COLOR_GRAY2RGB)
    for primitive in truth:
        _draw_outline(pixels, grid.frame, primitive.outline(), GREY)
    for thing in objects:
        _draw_outline(pixels, grid.frame, thing.outline, OBJECT_COLOR)
    for found in primitives:
        _draw_outline(pixels, grid.frame, found.primitive.outline(), found.kind.row.color)
    for thing in objects:
        _draw_label(pixels, grid.frame, thing.outline, LABEL_GREY, f"{thing.id}: {OTHER}")
    for found in primitives:
        _draw_label(pixels, grid.frame, found.primitive.outline(), found.kind.row.color, f"{found.id}: {found.kind}")
    _draw_scale_bar(pixels, grid.frame)
    return Picture(np.asarray(pixels, np.uint8))


def _to_pixels(points: FloatArray, frame: GridFrame, shape: tuple[int, ...]) -> FloatArray:
    """Convert points (N, 2) of the map (m) to columns and rows of a picture."""
    x0, y0, x1, y1 = frame.bounds
    scale = np.array([shape[1] / (x1 - x0), shape[0] / (y1 - y0)])
    return np.asarray((np.asarray(points) - (x0, y1)) * scale * (1, -1))


def _draw_outline(pixels: cv2.typing.MatLike, frame: GridFrame, outline: FloatArray, color: Color) -> None:
    vertices = np.rint(_to_pixels(outline, frame, pixels.shape) * (1 << SUBPIXEL_BITS)).astype(np.int32)
    cv2.polylines(pixels, [vertices], True, color, OUTLINE_THICKNESS, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_label(pixels: cv2.typing.MatLike, frame: GridFrame, outline: FloatArray, color: Color, text: str) -> None:
    """Write a text above an outline (m), white on its colour, within the picture."""
    (width, height), base = cv2.getTextSize(text, FONT, FONT_SCALE, TEXT_THICKNESS)
    drawn = _to_pixels(outline, frame, pixels.shape)
    x = int(np.clip(drawn[:, 0].mean() - width / 2, 2, max(2, pixels.shape[1] - width - 2)))
    y = int(np.clip(drawn[:, 1].min() - base - 2, height + 3, pixels.shape[0] - base))
    cv2.rectangle(pixels, (x - 2, y - height - 3), (x + width + 2, y + base), color, cv2.FILLED)
    cv2.putText(pixels, text, (x, y), FONT, FONT_SCALE, (255, 255, 255), TEXT_THICKNESS, cv2.LINE_AA)


def _draw_scale_bar(pixels: cv2.typing.MatLike, frame: GridFrame) -> None:
    """Draw a bar of 1, 2 or 5 times a power of ten metres at the lower left."""
    metres_per_pixel = frame.cols * frame.resolution / pixels.shape[1]
    longest = SCALE_BAR_SHARE * frame.cols * frame.resolution
    length = max((m * 10.0**e for e in range(-3, 4) for m in (1, 2, 5) if m * 10.0**e <= longest), default=longest)
    x, y, width = 10, pixels.shape[0] - 10, round(length / metres_per_pixel)
    cv2.line(pixels, (x, y), (x + width, y), (0, 90, 200), 3)
    cv2.putText(pixels, f"{length:g} m", (x, y - 6), FONT, FONT_SCALE, (0, 90, 200), TEXT_THICKNESS, cv2.LINE_AA)
