"""Recorded sessions from one end to the other, as a replay goes: mapped, looked at, refined by the log's rays.

Networks are measured as YOLOv5's own evaluation does: every candidate of every kind counts with its score, those
below the thresholds as well. What is refined is measured alike: every primitive that was fitted to rays counts as
each kind with the chance of that kind, and where it was no detection in the end, with a share of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from detect.detection import Detection, Detections
from detect.detector import Detector
from detect.evaluation.box_metrics import Marked, score_boxes
from detect.evaluation.evaluate import Pictured, errors_of, found_rates, mark
from detect.networks.tiles import cut, tiles
from detect.networks.yolo import KINDS, Boxes
from detect.refinement.refine import refine_detections
from detect.training.dataset import MARGIN, Sample, SetOptions, held_in, map_scans, recorded, session_options
from mapping.forward.mapper import cores
from mapping.grid import GridFrame
from prim.arrays import FloatArray
from prim.metrics import match_primitives
from prim.shapes import Primitive

LEAST_CHANCE = 0.001
"""A kind that is less likely than this does not count: as little as candidates that are not looked at."""

RIGHT_AFTER_ALL = 0.1
"""What was fitted and is no detection in the end counts with this share of its chances: seldom is it there."""


@dataclass(frozen=True)
class Told:
    """What was told of a session: scored boxes beside the true ones; what was found, with the truth it stands for
    (kind right, outlines overlap by half); how many were told in all, and how many there are.
    """

    marked: tuple[Marked, ...]
    pairs: tuple[tuple[Primitive, Primitive], ...]
    detections: int
    truths: int

    @classmethod
    def of(cls, marked: Iterable[Marked], found: Sequence[Detection], true: Sequence[Primitive]) -> Told:
        """Detections held against what is there."""
        told = [one.primitive for one in found]
        pairs = [(told[pair.detection], true[pair.truth]) for pair in match_primitives(told, true) if pair.found]
        return cls(tuple(marked), tuple(pairs), len(told), len(true))


def trial(seed: int, options: SetOptions, mapper: str, weights: Path) -> tuple[Told, Told]:
    """What is told of the session of a seed: by the networks alone, and refined."""
    world, scans = recorded(session_options(options, seed))
    x0, y0, x1, y1 = world.bounds
    frame = GridFrame.covering((x0 - MARGIN, y0 - MARGIN, x1 + MARGIN, y1 + MARGIN), options.resolution)
    grid = map_scans(mapper, scans, options.resolution, frame.bounds)
    detector = _loaded(weights, mapper)
    detections = detector.detect(grid)
    refined, _ = refine_detections(detections, scans, grid, None, 1)
    pictured = [
        Pictured(Sample(Path(), tile, held_in(tile, world.primitives), 0.0), cut(grid, tile, detector.card.style))
        for tile in tiles(frame)
    ]
    candidates = mark(detector.yolo, pictured)
    return (
        Told.of(candidates, detections.found, world.primitives),
        Told.of([marked(refined, world.primitives)], refined.found, world.primitives),
    )


def trials(seeds: Sequence[int], options: SetOptions, mapper: str, weights: Path) -> dict[str, Any]:
    """All sessions, on all cores: what the ``networks`` alone are worth, and what is ``refined``; as it is kept.

    Each holds ``boxes`` (box_metrics.Scores) and ``errors`` (evaluate.Errors) of all kinds and of
    each, and ``found``: precision, recall and F1.
    """
    with ProcessPoolExecutor(cores()) as pool:
        told = list(pool.map(partial(trial, options=options, mapper=mapper, weights=weights), seeds, chunksize=4))
    return {name: summed_up(own) for name, own in zip(("networks", "refined"), zip(*told, strict=True), strict=True)}


def summed_up(told: Sequence[Told]) -> dict[str, Any]:
    """Scores and errors over sessions."""
    pairs = [pair for one in told for pair in one.pairs]
    scores = score_boxes([marked for one in told for marked in one.marked])
    return {
        "boxes": {name: asdict(one) for name, one in scores.items()},
        "errors": {name: asdict(one) for name, one in errors_of(pairs).items()},
        "found": found_rates(len(pairs), sum(one.detections for one in told), sum(one.truths for one in told)),
    }


@lru_cache(maxsize=4)
def _loaded(weights: Path, mapper: str) -> Detector:
    return Detector.load(weights, mapper, 1)


def marked(refined: Detections, true: Sequence[Primitive]) -> Marked:
    """The boxes around outlines, as each kind that they may be of by its chance; beside the true ones, in cells of
    10 mm.
    """
    unsure = [one.fitted for one in refined.rejected if one.fitted is not None]
    told = [
        (box_around(one.primitive), KINDS.index(kind), share * chance)
        for ones, share in ((refined.found, 1.0), (unsure, RIGHT_AFTER_ALL))
        for one in ones
        for kind, chance in (one.chances or {one.primitive.kind: one.score}).items()
        if share * chance >= LEAST_CHANCE
    ]
    boxes = np.array([box for box, _, _ in told], np.float32).reshape(-1, 4)
    kinds = np.array([kind for _, kind, _ in told], np.intp)
    scores = np.array([chance for _, _, chance in told], np.float32)
    there = np.array([box_around(one) for one in true], np.float32).reshape(-1, 4)
    return Marked(Boxes(boxes, kinds, scores), there, np.array([KINDS.index(one.kind) for one in true], np.intp))


def box_around(primitive: Primitive) -> FloatArray:
    """Left, top, right, bottom in cells of 10 mm."""
    outline = 100 * primitive.outline()
    return np.concatenate((outline.min(axis=0), outline.max(axis=0)))
