"""Drawings of primitives to begin training from, where no pretrained weights can be had.

The paper starts YOLOv5 from weights that have seen photographs (COCO). These drawings take their place: outlines of
primitives, scattered, broken, blurred and speckled at random, that no robot has seen and no mapper has made. A
network that starts from them knows the five kinds; what maps look like it has yet to learn.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from detect.networks.tiles import TILE
from detect.training.dataset import SPLITS, box_of, write_image, write_yaml, yolo_line
from mapping.grid import UNKNOWN_GREY, GridFrame
from prim.errors import UsageError
from prim.shapes import Kind, Primitive

NAME = "drawings"
"""Stands where a set of maps has its mapper's name."""

RESOLUTION = 0.01
FRAME = GridFrame(RESOLUTION, 0, 0, TILE, TILE)
SIZES = (0.06, 0.34)
"""Between these (m) lie a drawing's widths and heights: a little more than what the recorder draws."""

RADII = (0.045, 0.3)
"""And its circles' radii."""

LEAST_HEIGHT = 0.06
"""A triangle is at least this high (m)."""

MOST_PER_KIND = 3
GAP = 4.0
"""Boxes of two primitives are at least this many cells apart."""


@dataclass(frozen=True)
class DrawingOptions:
    """How many drawings, and from which seed on. Raises UsageError on none."""

    sizes: tuple[int, int] = (6000, 100)
    seed: int = 900_000

    def __post_init__(self) -> None:
        if min(self.sizes) < 0 or not sum(self.sizes):
            raise UsageError("a set needs at least one drawing")


def make_drawings(folder: Path, options: DrawingOptions, progress: Callable[[int, int], None] | None = None) -> int:
    """Draws a set, or what is missing of it, as :mod:`~detect.training.dataset` keeps sets; returns how many are new.

    Raises UsageError where the folder holds a set of other options.
    """
    manifest = json.dumps({"version": 1, "tile": TILE} | vars(options)) + "\n"
    path = folder / "manifest.json"
    if path.exists() and path.read_text(encoding="utf-8") != manifest:
        raise UsageError(f"{folder} holds a set that was made with other options: give another folder")
    for split in SPLITS:
        for kind in ("images", "labels"):
            (folder / kind / NAME / split).mkdir(parents=True, exist_ok=True)
    path.write_text(manifest, encoding="utf-8")
    missing = [job for job in _jobs(options) if not _image(folder, *job).exists()]
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for done, _ in enumerate(pool.map(partial(_make, folder), missing, chunksize=50), start=1):
            if progress:
                progress(done, len(missing))
    write_yaml(folder, NAME)
    return len(missing)


def _jobs(options: DrawingOptions) -> Iterator[tuple[str, int]]:
    """Split and seed of every drawing."""
    first = options.seed
    for split, size in zip(SPLITS, options.sizes, strict=True):
        yield from ((split, seed) for seed in range(first, first + size))
        first += size


def _image(folder: Path, split: str, seed: int) -> Path:
    return folder / "images" / NAME / split / f"{seed:06d}.png"


def _make(folder: Path, job: tuple[str, int]) -> None:
    split, seed = job
    image, primitives = draw(np.random.default_rng(seed))
    label = "".join(yolo_line(primitive, FRAME) for primitive in primitives)
    (folder / "labels" / NAME / split / f"{seed:06d}.txt").write_text(label, encoding="utf-8")
    write_image(_image(folder, split, seed), image)


def draw(rng: np.random.Generator) -> tuple[NDArray[np.uint8], list[Primitive]]:
    """One drawing (TILE, TILE, 3), in the style of rounded or of grey maps, and what is in it."""
    primitives = _scatter_primitives(rng)
    room = _room(rng)
    points = _points(primitives, room, rng)
    probability = _ink(points, rng)
    known = _known(primitives, room, rng) | (probability > 0.5)
    probability = np.where(known, probability, 0.5)
    if rng.random() < 0.5:
        grey = np.select((probability > 0.5, probability < 0.5), (np.uint8(255), np.uint8(0)), np.uint8(UNKNOWN_GREY))
        return np.repeat(grey[..., None], 3, axis=2), primitives
    shown = np.where(known, np.uint8(255), np.uint8(0))
    evidence = (shown * rng.uniform(0.3, 1.0)).astype(np.uint8)
    return np.stack((np.rint(probability * 255).astype(np.uint8), evidence, shown), axis=-1), primitives


def _scatter_primitives(rng: np.random.Generator) -> list[Primitive]:
    """Primitives of all kinds whose boxes lie apart."""
    kinds = [kind for kind in Kind for _ in range(rng.integers(MOST_PER_KIND))]
    placed: list[Primitive] = []
    boxes: list[tuple[float, float, float, float]] = []
    for kind in kinds:
        for _ in range(20):
            x, y = rng.uniform(0.2, TILE * RESOLUTION - 0.2, 2)
            primitive = Primitive(kind, float(x), float(y), _angle(kind, rng), _size(kind, rng)).canonical()
            box = box_of(primitive, FRAME)
            if all(_apart(box, other) for other in boxes):
                placed.append(primitive)
                boxes.append(box)
                break
    return placed


def _angle(kind: Kind, rng: np.random.Generator) -> float | None:
    return float(rng.uniform(0, 2 * math.pi)) if kind.has_angle else None


def _size(kind: Kind, rng: np.random.Generator) -> tuple[float, ...]:
    """Sizes (m), drawn again until nothing is its kind's special case, nor too flat or too long."""
    low, high = SIZES
    if kind.is_tied:
        return (float(rng.uniform(*(RADII if kind.is_round else SIZES))),)
    while True:
        a, b = (float(value) for value in rng.uniform(low, high, 2))
        if kind.longer_first:
            if max(a, b) > 1.05 * min(a, b):
                return max(a, b) / kind.extent, min(a, b) / kind.extent
        elif b >= LEAST_HEIGHT and max(Primitive(kind, 0.0, 0.0, 0.0, (a, b)).sides) <= high:
            return a, b


def _apart(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[2] + GAP < b[0] or b[2] + GAP < a[0] or a[3] + GAP < b[1] or b[3] + GAP < a[1]


def _room(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Left, top, right, bottom (cells) of what is known."""
    left, top, right, bottom = rng.uniform(2, 16, 4)
    return float(left), float(top), float(TILE - right), float(TILE - bottom)


def _points(primitives: list[Primitive], room: tuple[float, ...], rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (N, 2) in cells along the outlines and, in most drawings, the walls: broken, scattered, speckled."""
    lines = [primitive.outline() / RESOLUTION for primitive in primitives]
    if rng.random() < 0.7:
        left, top, right, bottom = room
        lines.append(np.array([(left, top), (right, top), (right, bottom), (left, bottom)]))
    spread = 0.0 if rng.random() < 0.35 else rng.uniform(0.2, 6.0)
    density = rng.uniform(1.0, 8.0)
    parts = [np.empty((0, 2))]
    for line in lines:
        points = _along(line, density)
        if rng.random() < 0.3:  # a part of it was never seen
            first = rng.uniform(0, 1)
            share = (np.arange(len(points)) / len(points) - first) % 1.0
            points = points[share > rng.uniform(0.05, 0.35)]
        parts.append(points)
    points = np.concatenate(parts)
    # scattered along lines of sight from some of a few places, as ranges are
    eyes = rng.uniform(0, TILE, (8, 2))[rng.integers(8, size=len(points))]
    sight = points - eyes
    sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
    points = points + sight * rng.normal(0, spread, (len(points), 1)) if spread else points
    speckles = rng.uniform(0, TILE, (int(rng.exponential(150)) if rng.random() < 0.4 else 0, 2))
    return np.concatenate((points, speckles))


def _along(line: NDArray[np.float64], density: float) -> NDArray[np.float64]:
    """Points along a closed line, ``density`` a cell."""
    ends = np.concatenate((line, line[:1]))
    steps = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    at = np.concatenate(([0.0], np.cumsum(steps)))
    where = np.arange(0, at[-1], 1 / density)
    return np.column_stack([np.interp(where, at, ends[:, axis]) for axis in (0, 1)])


def _ink(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """How dark each cell is (TILE, TILE), 0 to 1: points counted, spread by a random pen, made sharp or left soft."""
    from PIL import Image, ImageFilter

    cells = np.floor(points).astype(int)
    inside = ((cells >= 0) & (cells < TILE)).all(axis=1)
    counts = np.zeros((TILE, TILE))
    np.add.at(counts, (cells[inside, 1], cells[inside, 0]), 1.0)
    soft = counts
    if rng.random() < 0.6:
        scaled = Image.fromarray(np.minimum(counts * 60, 255).astype(np.uint8))
        soft = np.asarray(scaled.filter(ImageFilter.GaussianBlur(rng.uniform(0.4, 2.0))), dtype=float) / 60
    level = rng.uniform(0.15, 0.6) * max(float(np.percentile(soft[soft > 0], 75)), 1e-9) if soft.any() else 1.0
    pale = rng.uniform(0.0, 0.3)
    if rng.random() < 0.5:
        return np.where(soft > level, rng.uniform(0.7, 1.0), pale)
    return np.clip(pale + (0.55 - pale) * soft / level, 0.0, 1.0)


def _known(primitives: list[Primitive], room: tuple[float, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which cells a robot would know (TILE, TILE): the room, in most drawings without the primitives' insides."""
    from PIL import Image, ImageDraw

    canvas = Image.new("L", (TILE, TILE), 0)
    pen = ImageDraw.Draw(canvas)
    pen.rectangle(room, fill=1)
    if rng.random() < 0.8:
        for primitive in primitives:
            pen.polygon([(float(x), float(y)) for x, y in primitive.outline() / RESOLUTION], fill=0)
    return np.asarray(canvas) > 0
