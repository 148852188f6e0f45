"""From a map to primitives: tiles, boxes, crops, parameters (the paper's III-C), on ONNX Runtime."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from detect.detection import Detection, Detections, Rejection
from detect.networks.cnn import Estimator, Found
from detect.networks.tiles import TILE, cut, tiles, window
from detect.networks.weights import Weights, load_set
from detect.networks.yolo import KINDS, Boxes, Yolo, overlap, suppress
from mapping.grid import GridFrame, OccupancyGrid
from prim.errors import UsageError
from prim.metrics import polygon_areas
from prim.shapes import Primitive

DOUBTFUL = 0.08
"""What scores less than its kind's threshold, but this much at least, is left to the rays to judge."""

MOST_DOUBTFUL = 24
"""No more than so many are: the best."""

FLOOR = 0.05
"""What YOLO gives a lower score than this is no candidate."""

DEFAULT_THRESHOLD = 0.25
"""The least score of a kind whose card names none: YOLOv5's own."""

OVERLAP_LIMIT = 0.45
"""Of two candidates that overlap by more than this (IoU), the better stays: YOLOv5's own."""

COVER_LIMIT = 0.25
"""Of two measured outlines that share more than this (of the smaller one's area), the better stays."""

EDGE = 2
"""A box that comes this near (cells) to a tile's border, where the map goes on, is left to the next tile."""

BATCH = 8
"""Tiles that go through the network at once: what bounds memory."""


@dataclass(frozen=True)
class _Looked:
    """A tile, its grey image (TILE, TILE), and the candidates in it, in the plane's cells."""

    tile: GridFrame
    grey: NDArray[np.uint8]
    boxes: Boxes


Item = TypeVar("Item")
Scored = TypeVar("Scored", Detection, Rejection)


class Detector:
    """Finds primitives in maps of one mapper; see :meth:`load`."""

    def __init__(self, yolo: Weights, networks: Sequence[Weights]) -> None:
        """Raises WeightsError where a network is not what its card says."""
        self.card = yolo.card
        self.yolo = Yolo(yolo)
        self.estimator = Estimator(networks)
        self.thresholds = {kind: float(yolo.card.thresholds.get(kind, DEFAULT_THRESHOLD)) for kind in KINDS}

    @classmethod
    def load(cls, path: Path, mapper: str | None = None, threads: int | None = None) -> Detector:
        """A detector from a folder of weights, or YOLO's file in it. Raises WeightsError on what cannot be used."""
        return cls(*load_set(path, mapper, threads))

    def detect(self, grid: OccupancyGrid) -> Detections:
        """The primitives in a map.

        Raises UsageError on a map of another resolution than the networks were trained on.
        """
        if not np.isclose(grid.frame.resolution, self.card.resolution, rtol=1e-6):
            wanted, got = self.card.resolution, grid.frame.resolution
            raise UsageError(f"the detector reads maps with cells of {wanted:g} m, not {got:g} m")
        return self.detect_images(
            ((tile, cut(grid, tile, self.card.style)) for tile in _worth_a_look(grid)), grid.frame
        )

    def detect_images(self, images: Iterable[tuple[GridFrame, NDArray[np.uint8]]], frame: GridFrame) -> Detections:
        """The primitives in a map that is given as its tiles' images (TILE, TILE, 3); ``frame`` is the map's."""
        looked = list(self._look(images))
        boxes = Boxes.joined([one.boxes for one in looked])
        of = [one for one in looked for _ in range(len(one.boxes))]
        least = np.array([self.thresholds[KINDS[kind]] for kind in boxes.kind.tolist()], np.float32)
        whole = np.array(
            [_is_whole(box, one.tile, frame) for box, one in zip(boxes.box, of, strict=True)], dtype=bool
        )
        better = _suppressed(boxes, whole & (boxes.score >= least), [len(one.boxes) for one in looked])
        kept = np.flatnonzero(better == np.arange(len(boxes)))
        detections, overlapping = _apart(_best_first(self._measured(kept, boxes, of, frame)))
        rejections = {
            i: _rejection(boxes, i, frame, self._reason(boxes, i, by, bool(whole[i])))
            for i, by in enumerate(better.tolist())
            if by != i
        }
        maybe = _doubtful(boxes, whole & (better < 0), kept)
        doubtful = zip(self._measured(maybe, boxes, of, frame), [rejections[i] for i in maybe.tolist()], strict=True)
        return Detections(detections, _best_first([*overlapping, *rejections.values()]), tuple(doubtful))

    def _measured(
        self, chosen: NDArray[np.intp], boxes: Boxes, of: Sequence[_Looked], frame: GridFrame
    ) -> list[Detection]:
        """Some of the candidates with the parameters that are read from their crops."""
        found = [_found(of[i], boxes, i) for i in chosen.tolist()]
        return [
            Detection(primitive, float(boxes.score[i]), _metres(boxes, i, frame), self.estimator.crop(one))
            for i, one, primitive in zip(chosen.tolist(), found, self.estimator(found), strict=True)
        ]

    def _look(self, images: Iterable[tuple[GridFrame, NDArray[np.uint8]]]) -> Iterator[_Looked]:
        """What YOLO sees in tiles, where it sees anything."""
        for batch in _batches(iter(images)):
            for (tile, image), seen in zip(
                batch, self.yolo(np.stack([image for _, image in batch]), FLOOR), strict=True
            ):
                if len(seen):
                    yield _Looked(tile, np.ascontiguousarray(image[..., 0]), seen.moved(tile.col, tile.row))

    def _reason(self, boxes: Boxes, i: int, by: int, whole: bool) -> str:
        """Why a candidate is no detection."""
        if by >= 0:
            return f"overlaps a better {KINDS[boxes.kind[by]]} by more than {OVERLAP_LIMIT:g} (IoU)"
        if not whole:
            return f"within {EDGE} cells of its tile's border: the next tile holds it whole"
        kind = KINDS[boxes.kind[i]]
        return f"score {boxes.score[i]:.2f} is below {self.thresholds[kind]:.2f}, the least for a {kind}"


def _suppressed(boxes: Boxes, among: NDArray[np.bool_], per_tile: Sequence[int]) -> NDArray[np.intp]:
    """As :func:`suppress`: within each tile first, and then what is left across their seams."""
    by = np.full(len(boxes), -1, np.intp)
    first = 0
    for count in per_tile:
        own = np.arange(first, first + count)
        inner = suppress(boxes[own], OVERLAP_LIMIT, among=among[own])
        by[own] = np.where(inner >= 0, inner + first, -1)
        first += count
    left = np.flatnonzero(by == np.arange(len(boxes)))
    if len(per_tile) > 1:
        by[left] = left[suppress(boxes[left], OVERLAP_LIMIT)]
    return by


def _doubtful(boxes: Boxes, among: NDArray[np.bool_], kept: NDArray[np.intp]) -> NDArray[np.intp]:
    """Candidates that score too little, but are none of what was kept and the best of their place."""
    among = among & (boxes.score >= DOUBTFUL)
    for i in kept.tolist():
        among &= overlap(boxes.box[i], boxes.box) <= OVERLAP_LIMIT
    best = np.flatnonzero(suppress(boxes, OVERLAP_LIMIT, among=among) == np.arange(len(boxes)))
    return best[np.argsort(-boxes.score[best], kind="stable")][:MOST_DOUBTFUL]


def _apart(measured: Sequence[Detection]) -> tuple[tuple[Detection, ...], list[Rejection]]:
    """Those, of detections best first, whose outlines keep clear of better ones: two things are not in one place."""
    stay: list[int] = []
    rejected = []
    for i, one in enumerate(measured):
        shared = [_covered(one.primitive, measured[k].primitive) for k in stay]
        if max(shared, default=0.0) <= COVER_LIMIT:
            stay.append(i)
            continue
        better = measured[stay[int(np.argmax(shared))]].primitive.kind
        reason = f"its outline covers that of a better {better} by more than {COVER_LIMIT:g} of the smaller one"
        x0, y0, x1, y1 = one.box
        rejected.append(Rejection(one.primitive.kind, one.score, (x0 + x1) / 2, (y0 + y1) / 2, reason))
    return tuple(measured[i] for i in stay), rejected


def _covered(a: Primitive, b: Primitive) -> float:
    """How much two outlines share, of the smaller one's area."""
    if math.hypot(a.x - b.x, a.y - b.y) > sum(max(one.width_height) for one in (a, b)):
        return 0.0
    first, second, shared = polygon_areas(a, b)
    return shared / min(first, second)


def _found(looked: _Looked, boxes: Boxes, i: int) -> Found:
    """A candidate as the estimator takes it."""
    tile = looked.tile
    left, top, right, bottom = boxes.box[i].tolist()
    box = (left - tile.col, top - tile.row, right - tile.col, bottom - tile.row)
    return Found(looked.grey, tile, box, KINDS[boxes.kind[i]])


def _best_first(of: Iterable[Scored]) -> tuple[Scored, ...]:
    return tuple(sorted(of, key=lambda one: -one.score))


def _worth_a_look(grid: OccupancyGrid) -> Iterator[GridFrame]:
    """The tiles with anything occupied in them."""
    for tile in tiles(grid.frame):
        part = window(grid, tile)
        if part is not None and part.occupied.any():
            yield tile


def _batches(of: Iterator[Item]) -> Iterator[list[Item]]:
    while batch := list(islice(of, BATCH)):
        yield batch


def _is_whole(box: NDArray[np.float32], tile: GridFrame, frame: GridFrame) -> bool:
    """Whether a box (plane's cells) keeps off those borders of its tile beyond which the map goes on."""
    left, top, right, bottom = box.tolist()
    cut_off = (
        frame.col < tile.col and left < tile.col + EDGE,
        frame.row < tile.row and top < tile.row + EDGE,
        frame.col + frame.cols > tile.col + TILE and right > tile.col + TILE - EDGE,
        frame.row + frame.rows > tile.row + TILE and bottom > tile.row + TILE - EDGE,
    )
    return not any(cut_off)


def _metres(boxes: Boxes, i: int, frame: GridFrame) -> tuple[float, float, float, float]:
    """A candidate's box in metres."""
    left, bottom, right, top = (float(value) * frame.resolution for value in boxes.box[i])
    return left, bottom, right, top


def _rejection(boxes: Boxes, i: int, frame: GridFrame, reason: str) -> Rejection:
    left, bottom, right, top = _metres(boxes, i, frame)
    return Rejection(KINDS[boxes.kind[i]], float(boxes.score[i]), (left + right) / 2, (bottom + top) / 2, reason)
