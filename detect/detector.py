"""From a map to primitives on ONNX Runtime: tiles, boxes, crops, parameters (the paper's III-C)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from detect.detection import Detection, Detections, Progress, Rejection, no_progress
from detect.networks.cnn import ClassifiedRegion, ParameterEstimator
from detect.networks.tiles import TILE_MARGIN, TILE_SIZE, tile_around, tile_frames, tile_image
from detect.networks.weights import BATCHES, Weights, load_weight_set
from detect.networks.yolo import KINDS, Boxes, Yolo, box_iou, non_maximum_suppression
from mapping.grid import GridFrame, OccupancyGrid
from mapping.morphology import isolated_boxes
from mapping.pyramid import DEFAULTS as PYRAMID
from mapping.pyramid import coarser, levels_for
from prim.choices import DEFAULT_SIZES
from prim.metrics import overlap_coefficient, polygon_iou
from prim.world import Bounds


@dataclass(frozen=True)
class DetectorOptions:
    """Parameters of the detector.

    A candidate's score decides first. Below ``score_floor`` it is dropped, below ``doubtful_threshold`` rejected,
    below its kind's threshold (the model card's, else ``default_threshold``) doubtful: refinement decides. From there
    on it is detected, unless it overlaps a better one.
    """

    score_floor: float = 0.05
    """Smallest score of a candidate; set by hand."""

    default_threshold: float = 0.25
    """Smallest score of a detection of a kind whose model card names none: YOLOv5's default."""

    doubtful_threshold: float = 0.08
    """Smallest score of candidates below their kind's threshold that are passed on to refinement; set by hand."""

    max_doubtful: int = 24
    """Largest number of these, the best; set by hand: it bounds the time of refinement."""

    nms_iou: float = 0.45
    """Largest intersection over union of two detections' boxes: YOLOv5's default."""

    max_candidates: int = 1200
    """Largest number of candidates of a tile, the best; the shipped networks have 1029 at most."""

    max_per_tile: int = 100
    """Largest number of detections in a tile, the best: as many as COCO's metric takes of an image."""

    max_overlap: float = 0.25
    """Largest intersection of two detections' outlines over the smaller one's area (no IoU); set by hand."""

    same_iou: float = 0.8
    """Two detections in cells of different sizes are the same where the intersection of their outlines over the union
    is larger; set by hand."""

    slack: float = 0.8
    """What is by this factor smaller, or as much larger, than what is searched for in cells of one size counts, too:
    the networks' sizes are not exact. Set by hand."""

    border: int = 2
    """Boxes this near (cells) to a tile's border, where the map goes on, are left to the next tile; set by hand."""

    batch_size: int = BATCHES["yolo"]
    """Tiles in one batch of the network."""


DEFAULTS = DetectorOptions()


@dataclass(frozen=True)
class _TileCandidates:
    """Candidates in one tile.

    Attributes:
        tile: The tile's frame.
        grey: First channel (TILE_SIZE, TILE_SIZE) of its image.
        boxes: The candidates, in cells of the plane (those of the frames' columns and rows).
    """

    tile: GridFrame
    grey: NDArray[np.uint8]
    boxes: Boxes


@dataclass(frozen=True)
class _SeenMap:
    """A map as the networks see it.

    Attributes:
        grid: The map, with cells as they know them.
        tiles: The tiles that are searched.
        extents: From which to which extent (cells), from corner to corner, primitives are searched for.
        scale: How many times as large its cells really are.
    """

    grid: OccupancyGrid
    tiles: tuple[GridFrame, ...]
    extents: tuple[float, float]
    scale: float


NOTHING = Detections((), ())

Item = TypeVar("Item")
Scored = TypeVar("Scored", Detection, Rejection)


class Detector:
    """A detector of primitives in the maps of one mapper; see :meth:`load`.

    Attributes:
        card: Model card of YOLO.
        yolo: The network that finds boxes.
        estimator: The networks that estimate parameters from crops.
        thresholds: Smallest score of a detection of each kind.
        options: Further parameters.
    """

    def __init__(self, yolo: Weights, networks: Sequence[Weights], options: DetectorOptions = DEFAULTS) -> None:
        """Check the networks against their model cards.

        Args:
            yolo: The network that finds boxes.
            networks: The networks that estimate parameters, at least one for each kind.
            options: Further parameters.

        Raises:
            WeightsError: A network is not what its model card says.
        """
        self.card = yolo.card
        self.yolo = Yolo(yolo)
        self.estimator = ParameterEstimator(networks)
        self.options = options
        default = options.default_threshold
        self.thresholds = {kind: float(yolo.card.thresholds.get(kind, default)) for kind in KINDS}

    @classmethod
    def load(cls, path: Path, mapper: str | None = None, threads: int | None = None) -> Detector:
        """Load a detector.

        Args:
            path: A folder of weights, or YOLO's file in it.
            mapper: The mapper whose maps it must read; None: any.
            threads: Threads that run each network; None: one for each core.

        Returns:
            The detector.

        Raises:
            WeightsError: The weights cannot be used.
        """
        return cls(*load_weight_set(path, mapper, threads))

    def detect(
        self, grid: OccupancyGrid, sizes: tuple[float, float] = DEFAULT_SIZES, progress: Progress = no_progress
    ) -> Detections:
        """Detect the primitives in a map, each in cells of a size that shows it well.

        Args:
            grid: The map, with cells of any size.
            sizes: The smallest and the largest size that is searched for (m): the longest side, or the diameter.
            progress: Called after each tile with their number so far and in all.

        Returns:
            Detections, rejected and doubtful candidates.

        Raises:
            WeightsError: A network does not take its images, or gives outputs that are not finite.
        """
        seen = list(self._seen_at_levels(grid, sizes))
        total = sum(len(one.tiles) for one in seen)
        done = itertools.count(1)

        def images(one: _SeenMap) -> Iterator[tuple[GridFrame, NDArray[np.uint8]]]:
            """Yield the tiles' images."""
            for tile in one.tiles:
                yield tile, tile_image(one.grid, tile, self.card.style)
                progress(next(done), total)

        parts = [
            _scaled(self.detect_tiles(images(one), one.grid.frame, one.extents), one.scale) if one.tiles else NOTHING
            for one in seen
        ]
        return parts[0] if len(parts) == 1 else self._merged(parts)

    def _seen_at_levels(self, grid: OccupancyGrid, sizes: tuple[float, float]) -> Iterator[_SeenMap]:
        """Yield a map at each size of its cells that the wanted things need, taken for the one the networks know."""
        factor, slack = 1, self.options.slack
        for level in levels_for(grid.frame.resolution, sizes):
            grid, factor = coarser(grid, level.factor // factor), level.factor
            known = replace(grid, frame=replace(grid.frame, resolution=self.card.resolution))
            lower, upper = (extent / level.resolution for extent in level.extents)
            scale = level.resolution / self.card.resolution
            yield _SeenMap(known, tuple(_tiles_of_things(known)), (slack * lower, upper / slack), scale)

    def _merged(self, parts: Sequence[Detections]) -> Detections:
        """Put together what was detected in cells of several sizes."""
        best = _best_first(one for part in parts for one in part.found)
        found, overlapping = _reject_overlapping(best, self.options.max_overlap)
        rivals = [pair for pair in overlapping if self._differs(pair[0], found)]
        doubtful = [pair for part in parts for pair in part.doubtful if self._differs(pair[0], found)]
        doubtful = sorted(doubtful, key=lambda pair: -pair[0].score)[: self.options.max_doubtful]
        rejected = [*(rejection for _, rejection in overlapping), *(one for part in parts for one in part.rejected)]
        return Detections(found, _best_first(rejected), tuple(doubtful), tuple(rivals))

    def _differs(self, detection: Detection, others: Sequence[Detection]) -> bool:
        """Return whether a detection differs in place or size from all others."""
        limit = self.options.same_iou
        return all(polygon_iou(detection.primitive, other.primitive) < limit for other in others)

    def detect_tiles(
        self,
        images: Iterable[tuple[GridFrame, NDArray[np.uint8]]],
        frame: GridFrame,
        extents: tuple[float, float] = (0.0, math.inf),
    ) -> Detections:
        """Detect the primitives in a map that is given as images of its tiles.

        Args:
            images: Frames of tiles and their images (TILE_SIZE, TILE_SIZE, 3).
            frame: The map's frame, with cells as the networks know them.
            extents: From which to which extent (cells), from corner to corner, primitives are searched for.

        Returns:
            Detections, rejected and doubtful candidates.

        Raises:
            WeightsError: A network does not take its images, or gives outputs that are not finite.
        """
        parts = list(self._candidates(images, extents))
        boxes = Boxes.concatenate([part.boxes for part in parts])
        part_of = [part for part in parts for _ in range(len(part.boxes))]
        thresholds = np.array([self.thresholds[KINDS[kind]] for kind in boxes.kind.tolist()], np.float32)
        whole = np.array(
            [self._is_whole(box, part.tile, frame) for box, part in zip(boxes.box, part_of, strict=True)], dtype=bool
        )
        suppressor = self._suppress(boxes, whole & (boxes.score >= thresholds), [len(part.boxes) for part in parts])
        kept, excess = self._best_of_each_tile(suppressor == np.arange(len(boxes)), boxes, part_of)
        estimated = self._estimate(kept, boxes, part_of, frame, extents)
        found, overlapping = _reject_overlapping(_best_first(estimated.values()), self.options.max_overlap)
        reasons = {
            i: self._reason(boxes, i, better, bool(whole[i]))
            for i, better in enumerate(suppressor.tolist())
            if better != i
        }
        reasons |= dict.fromkeys(excess.tolist(), f"its tile has {self.options.max_per_tile} better ones")
        nowhere = "its tile holds no such primitive, or its size is searched for in other cells"
        reasons |= {i: nowhere for i in kept.tolist() if i not in estimated}
        rejections = {i: _rejection(boxes, i, frame, reason) for i, reason in reasons.items()}
        chosen = self._doubtful(boxes, whole & (suppressor < 0), kept)
        doubtful = self._estimate(chosen, boxes, part_of, frame, extents)
        return Detections(
            found,
            _best_first([*(rejection for _, rejection in overlapping), *rejections.values()]),
            tuple((detection, rejections[i]) for i, detection in doubtful.items()),
        )

    def _candidates(
        self, images: Iterable[tuple[GridFrame, NDArray[np.uint8]]], extents: tuple[float, float]
    ) -> Iterator[_TileCandidates]:
        """Run YOLO on tiles; yield those with candidates of these extents (cells)."""
        for batch in _batches(iter(images), self.options.batch_size):
            stacked = np.stack([image for _, image in batch])
            for (tile, image), boxes in zip(batch, self.yolo(stacked, self.options.score_floor), strict=True):
                boxes = boxes[_may_be_wanted(boxes, extents)]
                if len(boxes):
                    grey = np.ascontiguousarray(image[..., 0])
                    if len(boxes) > self.options.max_candidates:
                        best = np.argsort(-boxes.score, kind="stable")[: self.options.max_candidates]
                        boxes = boxes[np.sort(best)]
                    yield _TileCandidates(tile, grey, boxes.translated(tile.col, tile.row))

    def _is_whole(self, box: NDArray[np.float32], tile: GridFrame, frame: GridFrame) -> bool:
        """Return whether a box (cells of the plane) is clear of its tile's borders where the map goes on."""
        x0, y0, x1, y1 = box.tolist()
        border = self.options.border
        truncated = (
            frame.col < tile.col and x0 < tile.col + border,
            frame.row < tile.row and y0 < tile.row + border,
            frame.col + frame.cols > tile.col + TILE_SIZE and x1 > tile.col + TILE_SIZE - border,
            frame.row + frame.rows > tile.row + TILE_SIZE and y1 > tile.row + TILE_SIZE - border,
        )
        return not any(truncated)

    def _suppress(self, boxes: Boxes, eligible: NDArray[np.bool_], per_tile: Sequence[int]) -> NDArray[np.intp]:
        """Suppress within each tile first, then what remains across tiles; see :func:`non_maximum_suppression`."""
        suppressor = np.full(len(boxes), -1, np.intp)
        first = 0
        for count in per_tile:
            own = np.arange(first, first + count)
            inner = non_maximum_suppression(boxes[own], self.options.nms_iou, eligible=eligible[own])
            suppressor[own] = np.where(inner >= 0, inner + first, -1)
            first += count
        rest = np.flatnonzero(suppressor == np.arange(len(boxes)))
        if len(per_tile) > 1:
            suppressor[rest] = rest[non_maximum_suppression(boxes[rest], self.options.nms_iou)]
        return suppressor

    def _best_of_each_tile(
        self, kept: NDArray[np.bool_], boxes: Boxes, part_of: Sequence[_TileCandidates]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Split the indices of kept candidates into those of the best in each tile, and the rest."""
        counts: dict[tuple[int, int], int] = {}
        chosen = np.zeros(len(boxes), np.bool_)
        indices = np.flatnonzero(kept)
        for i in indices[np.argsort(-boxes.score[indices], kind="stable")].tolist():
            tile = part_of[i].tile.row, part_of[i].tile.col
            counts[tile] = counts.get(tile, 0) + 1
            chosen[i] = counts[tile] <= self.options.max_per_tile
        return np.flatnonzero(chosen), np.flatnonzero(kept & ~chosen)

    def _estimate(
        self,
        chosen: NDArray[np.intp],
        boxes: Boxes,
        part_of: Sequence[_TileCandidates],
        frame: GridFrame,
        extents: tuple[float, float],
    ) -> dict[int, Detection]:
        """Return those of some candidates by their indices that their crops show a primitive for, with parameters."""
        regions = [_region(part_of[i], boxes, i) for i in chosen.tolist()]
        lower, upper = (extent * frame.resolution for extent in extents)
        return {
            i: Detection(
                primitive, float(boxes.score[i]), _box_in_metres(boxes, i, frame), self.estimator.crop(region)
            )
            for i, region, primitive in zip(chosen.tolist(), regions, self.estimator(regions), strict=True)
            if primitive is not None and lower <= 2 * primitive.bounding_radius <= upper
        }

    def _doubtful(self, boxes: Boxes, eligible: NDArray[np.bool_], kept: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the best candidates with too small a score that no kept one overlaps, in descending order."""
        options = self.options
        eligible = eligible & (boxes.score >= options.doubtful_threshold)
        for i in kept.tolist():
            eligible &= box_iou(boxes.box[i], boxes.box) <= options.nms_iou
        suppressor = non_maximum_suppression(boxes, options.nms_iou, eligible=eligible)
        best = np.flatnonzero(suppressor == np.arange(len(boxes)))
        return best[np.argsort(-boxes.score[best], kind="stable")][: options.max_doubtful]

    def _reason(self, boxes: Boxes, i: int, suppressor: int, whole: bool) -> str:
        """Return why a candidate is rejected."""
        if suppressor >= 0:
            better = KINDS[boxes.kind[suppressor]]
            return f"overlaps a better {better} by more than {self.options.nms_iou:g} (IoU)"
        if not whole:
            return f"within {self.options.border} cells of its tile's border: the next tile holds it whole"
        kind = KINDS[boxes.kind[i]]
        return f"score {boxes.score[i]:.2f} is below {self.thresholds[kind]:.2f}, the least for a {kind}"


def _reject_overlapping(
    detections: Sequence[Detection], max_overlap: float
) -> tuple[tuple[Detection, ...], list[tuple[Detection, Rejection]]]:
    """Split detections, best first, into those whose outlines are clear of better ones, and the rest with reasons."""
    kept: list[Detection] = []
    rejected = []
    for detection in detections:
        overlaps = [overlap_coefficient(detection.primitive, other.primitive) for other in kept]
        if max(overlaps, default=0.0) <= max_overlap:
            kept.append(detection)
            continue
        better = kept[int(np.argmax(overlaps))].primitive.kind
        reason = f"its outline covers that of a better {better} by more than {max_overlap:g} of the smaller one"
        x0, y0, x1, y1 = detection.box
        kind = detection.primitive.kind
        rejected.append((detection, Rejection(kind, detection.score, (x0 + x1) / 2, (y0 + y1) / 2, reason)))
    return tuple(kept), rejected


def _region(part: _TileCandidates, boxes: Boxes, i: int) -> ClassifiedRegion:
    """Return a candidate as the estimator takes it."""
    tile = part.tile
    x0, y0, x1, y1 = boxes.box[i].tolist()
    box = (x0 - tile.col, y0 - tile.row, x1 - tile.col, y1 - tile.row)
    return ClassifiedRegion(part.grey, tile, box, KINDS[boxes.kind[i]])


def _best_first(items: Iterable[Scored]) -> tuple[Scored, ...]:
    return tuple(sorted(items, key=lambda item: -item.score))


def _may_be_wanted(boxes: Boxes, extents: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which boxes may bound primitives of some extents (cells): turned, a square's box is smaller by half."""
    lower, upper = extents
    sides = (boxes.box[:, 2:] - boxes.box[:, :2]).max(axis=1)
    return np.asarray((sides >= lower / math.sqrt(2)) & (sides <= upper))


def _tiles_of_things(grid: OccupancyGrid) -> Iterator[GridFrame]:
    """Yield the tiles that show what stands isolated: the whole map where one tile does, else one around each group.

    Of a map of many tiles most show walls, and nothing else.
    """
    occupied = grid.occupied
    if max(grid.frame.shape) <= TILE_SIZE:
        yield from tile_frames(grid.frame) if occupied.any() else ()
        return
    things = isolated_boxes(occupied, round(PYRAMID.seen_cells))
    while len(things):
        tile = tile_around(things[0], grid.frame)
        yield tile
        things = things[1:][~_is_inside(things[1:], tile, grid.frame)]


def _is_inside(boxes: NDArray[np.intp], tile: GridFrame, frame: GridFrame) -> NDArray[np.bool_]:
    """Return which boxes (N, 4: first and last row and column) lie in a tile, with a margin where the map goes on."""
    row, col = tile.row - frame.row, tile.col - frame.col
    low = boxes[:, [0, 2]] - [row, col] >= TILE_MARGIN
    high = [row + TILE_SIZE, col + TILE_SIZE] - boxes[:, [1, 3]] > TILE_MARGIN
    return np.asarray((low & high).all(axis=1))


def _scaled(found: Detections, scale: float) -> Detections:
    """Return detections in a map whose cells are so many times as large."""
    if math.isclose(scale, 1, rel_tol=PYRAMID.rounding):
        return found

    def larger(detection: Detection) -> Detection:
        x0, y0, x1, y1 = detection.box
        return replace(
            detection,
            primitive=detection.primitive.scaled(scale),
            box=(scale * x0, scale * y0, scale * x1, scale * y1),
        )

    moved = {id(one): replace(one, x=scale * one.x, y=scale * one.y) for one in found.rejected}
    return Detections(
        tuple(larger(one) for one in found.found),
        tuple(moved[id(one)] for one in found.rejected),
        tuple((larger(one), moved[id(rejection)]) for one, rejection in found.doubtful),
    )


def _batches(items: Iterator[Item], size: int) -> Iterator[list[Item]]:
    while batch := list(islice(items, size)):
        yield batch


def _box_in_metres(boxes: Boxes, i: int, frame: GridFrame) -> Bounds:
    x0, y0, x1, y1 = (float(value) * frame.resolution for value in boxes.box[i])
    return x0, y0, x1, y1


def _rejection(boxes: Boxes, i: int, frame: GridFrame, reason: str) -> Rejection:
    x0, y0, x1, y1 = _box_in_metres(boxes, i, frame)
    return Rejection(KINDS[boxes.kind[i]], float(boxes.score[i]), (x0 + x1) / 2, (y0 + y1) / 2, reason)
