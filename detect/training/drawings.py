"""Drawings of primitives: synthetic images that training starts from where no pretrained weights are available.

The paper starts YOLOv5 from weights trained on photographs (COCO). Drawings take their place: outlines of primitives,
scattered, interrupted, blurred and speckled at random, without any simulated sensor or mapper. They teach a network
the kinds, but not the appearance of maps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from detect.networks.tiles import TILE_SIZE, Box
from detect.training.dataset import (
    OF_THE_SET,
    SPLITS,
    Progress,
    bounding_box,
    output_failure,
    prepare_folder,
    write_data_yaml,
    write_image,
    yolo_label,
)
from mapping.grid import UNKNOWN_GREY, GridFrame
from prim import strict_json
from prim.errors import OutputError, UsageError
from prim.files import write_file
from prim.processes import process_pool
from prim.shapes import Kind, Primitive

DRAWINGS = "drawings"
"""Name of drawings where a data set of maps has its mapper's name."""

RESOLUTION = 0.01
"""Side of a cell (m)."""

FRAME = GridFrame(RESOLUTION, 0, 0, TILE_SIZE, TILE_SIZE)
"""Frame of a drawing."""

SIZE_RANGE = (0.06, 0.34)
"""Smallest and largest extent (m) of a primitive: a little beyond the recorder's sizes."""

RADIUS_RANGE = (0.045, 0.3)
"""Smallest and largest radius (m) of a circle."""

MIN_TRIANGLE_HEIGHT = 0.06
"""Smallest height (m) of a triangle."""

PRIMITIVES_PER_KIND = 3
"""Exclusive upper bound of the number of primitives of each kind in a drawing."""

MIN_GAP = 4.0
"""Smallest gap (cells) between the bounding boxes of two primitives."""

PLACEMENT_ATTEMPTS = 20
"""Attempts to place a primitive before it is left out."""


@dataclass(frozen=True)
class DrawingOptions:
    """Contents of a set of drawings; the fields are the keys of its manifest.

    Attributes:
        sizes: Drawings of each of SPLITS.
        seed: Seed of the first drawing; the others' follow.

    Raises:
        UsageError: There are no drawings.
    """

    sizes: tuple[int, int] = (6000, 100)
    seed: int = 900_000

    def __post_init__(self) -> None:
        if min(self.sizes) < 0 or not sum(self.sizes):
            raise UsageError("a set needs at least one drawing")
        if self.seed < 0:
            raise UsageError(f"--seed is {self.seed}: it must not be below 0")


def make_drawings(folder: Path, options: DrawingOptions, progress: Progress | None = None) -> int:
    """Make a set of drawings, or what is missing of it, in the format of :mod:`~detect.training.dataset`.

    Args:
        folder: Its folder.
        options: Its contents.
        progress: Called after each drawing.

    Returns:
        How many drawings were made now.

    Raises:
        OutputError: The folder cannot be written.
        UsageError: The folder holds a data set with other options.
    """
    manifest = strict_json.dumps({"version": 2, "tile": TILE_SIZE} | vars(options)) + "\n"
    prepare_folder(folder, manifest, [f"{kind}/{DRAWINGS}" for kind in ("images", "labels")])
    missing = [job for job in _drawing_seeds(options) if not _image_path(folder, *job).exists()]
    with process_pool() as pool:
        for done, failed in enumerate(pool.map(partial(_make_drawing, folder), missing, chunksize=50), start=1):
            if failed:
                raise OutputError(*failed)
            if progress:
                progress(done, len(missing))
    write_data_yaml(folder, DRAWINGS)
    return len(missing)


def _drawing_seeds(options: DrawingOptions) -> Iterator[tuple[str, int]]:
    """Yield split and seed of every drawing."""
    first = options.seed
    for split, size in zip(SPLITS, options.sizes, strict=True):
        yield from ((split, seed) for seed in range(first, first + size))
        first += size


def _image_path(folder: Path, split: str, seed: int) -> Path:
    return folder / "images" / DRAWINGS / split / f"{seed:06d}.png"


def _make_drawing(folder: Path, job: tuple[str, int]) -> tuple[str, OSError] | None:
    """Make a drawing in a process of its own; return the file that cannot be written, and why."""
    return output_failure(partial(_write_drawing, folder, job))


def _write_drawing(folder: Path, job: tuple[str, int]) -> None:
    split, seed = job
    image, primitives = draw_primitives(np.random.default_rng(seed))
    label = "".join(yolo_label(primitive, FRAME) for primitive in primitives)
    write_file(folder / "labels" / DRAWINGS / split / f"{seed:06d}.txt", label.encode(), OF_THE_SET)
    write_image(_image_path(folder, split, seed), image)


def draw_primitives(rng: np.random.Generator) -> tuple[NDArray[np.uint8], list[Primitive]]:
    """Make a drawing (TILE_SIZE, TILE_SIZE, 3) in the style of rounded or grey maps, and list its primitives.

    Primitives are given in the map frame of FRAME (m).
    """
    primitives = _place_primitives(rng)
    room = _draw_room(rng)
    points = _sample_points(primitives, room, rng)
    probability = _render_points(points, rng)
    known = _known_cells(primitives, room, rng) | (probability > 0.5)
    probability = np.where(known, probability, 0.5)
    if rng.random() < 0.5:
        grey = np.select((probability > 0.5, probability < 0.5), (np.uint8(255), np.uint8(0)), np.uint8(UNKNOWN_GREY))
        return np.repeat(grey[..., None], 3, axis=2), primitives
    shown = np.where(known, np.uint8(255), np.uint8(0))
    visits = (shown * rng.uniform(0.3, 1.0)).astype(np.uint8)
    return np.stack((np.rint(probability * 255).astype(np.uint8), visits, shown), axis=-1), primitives


def _place_primitives(rng: np.random.Generator) -> list[Primitive]:
    """Draw primitives of all kinds with bounding boxes MIN_GAP apart."""
    kinds = [kind for kind in Kind for _ in range(rng.integers(PRIMITIVES_PER_KIND))]
    placed: list[Primitive] = []
    boxes: list[Box] = []
    for kind in kinds:
        for _ in range(PLACEMENT_ATTEMPTS):
            x, y = rng.uniform(0.2, TILE_SIZE * RESOLUTION - 0.2, 2)
            primitive = Primitive(kind, float(x), float(y), _draw_angle(kind, rng), _draw_size(kind, rng)).canonical()
            box = bounding_box(primitive, FRAME)
            if all(_are_apart(box, other) for other in boxes):
                placed.append(primitive)
                boxes.append(box)
                break
    return placed


def _draw_angle(kind: Kind, rng: np.random.Generator) -> float | None:
    return float(rng.uniform(0, 2 * math.pi)) if kind.has_angle else None


def _draw_size(kind: Kind, rng: np.random.Generator) -> tuple[float, ...]:
    """Draw sizes (m) by rejection: of no special case of the kind, not too flat, not too long."""
    low, high = SIZE_RANGE
    if kind.is_tied:
        return (float(rng.uniform(*RADIUS_RANGE) if kind.is_round else rng.uniform(*SIZE_RANGE) / kind.extent),)
    while True:
        a, b = (float(value) for value in rng.uniform(low, high, 2))
        if kind.longer_first:
            if max(a, b) > 1.05 * min(a, b):
                return max(a, b) / kind.extent, min(a, b) / kind.extent
        elif b >= MIN_TRIANGLE_HEIGHT and max(Primitive(kind, 0.0, 0.0, 0.0, (a, b)).sides) <= high:
            return a, b


def _are_apart(a: Box, b: Box) -> bool:
    return a[2] + MIN_GAP < b[0] or b[2] + MIN_GAP < a[0] or a[3] + MIN_GAP < b[1] or b[3] + MIN_GAP < a[1]


def _draw_room(rng: np.random.Generator) -> Box:
    """Draw the box of the room, whose cells are known: its margins to the tile's borders (cells) are uniform."""
    x0, y0, x1, y1 = rng.uniform(2, 16, 4)
    return float(x0), float(y0), float(TILE_SIZE - x1), float(TILE_SIZE - y1)


def _sample_points(primitives: list[Primitive], room: Box, rng: np.random.Generator) -> NDArray[np.float64]:
    """Sample points (N, 2) in cells on the outlines and, in most drawings, the walls; gaps, noise, speckles."""
    lines = [primitive.outline() / RESOLUTION for primitive in primitives]
    if rng.random() < 0.7:
        x0, y0, x1, y1 = room
        lines.append(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))
    spread = 0.0 if rng.random() < 0.35 else rng.uniform(0.2, 6.0)
    density = rng.uniform(1.0, 8.0)
    parts = [np.empty((0, 2))]
    for line in lines:
        points = _sample_polygon(line, density)
        if rng.random() < 0.3:  # a part of it is occluded
            first = rng.uniform(0, 1)
            share = (np.arange(len(points)) / len(points) - first) % 1.0
            points = points[share > rng.uniform(0.05, 0.35)]
        parts.append(points)
    points = np.concatenate(parts)
    # range noise: displacements along the lines of sight of eight random viewpoints
    viewpoints = rng.uniform(0, TILE_SIZE, (8, 2))[rng.integers(8, size=len(points))]
    directions = points - viewpoints
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    points = points + directions * rng.normal(0, spread, (len(points), 1)) if spread else points
    speckles = rng.uniform(0, TILE_SIZE, (int(rng.exponential(150)) if rng.random() < 0.4 else 0, 2))
    return np.concatenate((points, speckles))


def _sample_polygon(line: NDArray[np.float64], density: float) -> NDArray[np.float64]:
    """Sample points (N, 2) evenly along a closed polygon (M, 2), ``density`` for each cell of its length."""
    ends = np.concatenate((line, line[:1]))
    steps = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    at = np.concatenate(([0.0], np.cumsum(steps)))
    where = np.arange(0, at[-1], 1 / density)
    return np.column_stack([np.interp(where, at, ends[:, axis]) for axis in (0, 1)])


def _render_points(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Render points as occupancy (TILE_SIZE, TILE_SIZE), 0 to 1: counts, blurred at random, sharp or soft."""
    cells = np.floor(points).astype(int)
    inside = ((cells >= 0) & (cells < TILE_SIZE)).all(axis=1)
    counts = np.zeros((TILE_SIZE, TILE_SIZE))
    np.add.at(counts, (cells[inside, 1], cells[inside, 0]), 1.0)
    soft = counts
    if rng.random() < 0.6:
        scaled = np.minimum(counts * 60, 255).astype(np.uint8)
        soft = cv2.GaussianBlur(scaled, (0, 0), rng.uniform(0.4, 2.0), borderType=cv2.BORDER_REPLICATE) / 60
    level = rng.uniform(0.15, 0.6) * max(float(np.percentile(soft[soft > 0], 75)), 1e-9) if soft.any() else 1.0
    pale = rng.uniform(0.0, 0.3)
    if rng.random() < 0.5:
        return np.where(soft > level, rng.uniform(0.7, 1.0), pale)
    return np.clip(pale + (0.55 - pale) * soft / level, 0.0, 1.0)


def _known_cells(primitives: list[Primitive], room: Box, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which cells (TILE_SIZE, TILE_SIZE) are known: the room, mostly without the primitives' interiors."""
    known = np.zeros((TILE_SIZE, TILE_SIZE), np.uint8)
    x0, y0, x1, y1 = (int(side) for side in room)
    known[y0 : y1 + 1, x0 : x1 + 1] = 1
    if rng.random() < 0.8:
        for primitive in primitives:
            corners = primitive.outline() / RESOLUTION - 0.5  # OpenCV counts from the first pixel's centre
            cv2.fillPoly(known, [np.rint(corners * 16).astype(np.int32)], (0,), shift=4)
    return known > 0
