"""YOLO on ONNX Runtime: from images to candidate boxes with kinds and scores; non-maximum suppression.

The network is YOLOv5n as ultralytics builds it («YOLOv5u»): its head is the anchor-free one of YOLOv8. For each of N
locations, the cells of three feature maps, its output (4 + K, N) holds a box (centre and size in pixels) and K class
scores. There are neither anchor boxes nor an objectness, which the original YOLOv5 has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.networks.tiles import TILE_SIZE, BoxArray
from detect.networks.weights import BATCHES, Weights, WeightsError
from prim.shapes import Kind

KINDS = tuple(Kind)
"""The kind of each class index, in labels, candidates and ground truth."""

MAX_REACH = 512
"""Boxes that reach farther (cells) beyond their tile are dropped: what the head can say ends at 15 times its largest
stride of 32 cells."""

MAX_LOCATIONS = sum((TILE_SIZE // stride) ** 2 for stride in (4, 8, 16, 32))
"""Largest number of locations that a detector may have: those of a head with all strides from 4 to 32."""


@dataclass(frozen=True)
class Boxes:
    """Candidates of one image.

    Attributes:
        box: (N, 4) boxes in cells.
        kind: (N,) class indices (of KINDS).
        score: (N,) class scores, 0 to 1.
    """

    box: BoxArray
    kind: NDArray[np.intp]
    score: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.score)

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Boxes:
        return Boxes(self.box[chosen], self.kind[chosen], self.score[chosen])

    def translated(self, cols: int, rows: int) -> Boxes:
        """Return the candidates translated by whole cells.

        Args:
            cols: Translation along x (cells).
            rows: Translation along y (cells).

        Returns:
            Candidates of the same kinds and scores.
        """
        return Boxes(self.box + np.array([cols, rows, cols, rows], np.float32), self.kind, self.score)

    @classmethod
    def concatenate(cls, parts: Sequence[Boxes]) -> Boxes:
        """Return the candidates of all parts, in their order."""
        if not parts:
            return cls(np.empty((0, 4), np.float32), np.empty(0, np.intp), np.empty(0, np.float32))
        box, kind, score = ([getattr(part, name) for part in parts] for name in ("box", "kind", "score"))
        return cls(np.concatenate(box), np.concatenate(kind), np.concatenate(score))


class Yolo:
    """A YOLOv5u network that detects primitives in tiles.

    Attributes:
        weights: The network and its model card.
    """

    def __init__(self, weights: Weights) -> None:
        """Check the network against its model card.

        Raises:
            WeightsError: The network does not take tiles, or does not give boxes of the kinds of its card.
        """
        self.weights = weights
        self._kinds = np.array([KINDS.index(Kind(name)) for name in weights.card.kinds], np.intp)
        self._run(np.zeros(weights.card.input_shape(1), np.float32))

    def __call__(self, images: NDArray[np.uint8], score_floor: float, multi_label: bool = False) -> list[Boxes]:
        """Return the candidates of a batch of images, before non-maximum suppression.

        Args:
            images: (N, TILE_SIZE, TILE_SIZE, 3).
            score_floor: Smallest class score of a candidate.
            multi_label: Whether a location is a candidate for each kind that reaches the floor, as in YOLOv5's
                validation, or for the one with the largest score only.

        Returns:
            The candidates of each image.

        Raises:
            WeightsError: The network does not take the images, or gives outputs that are not finite, or scores above
                1.
        """
        scaled = np.ascontiguousarray(images.transpose(0, 3, 1, 2), dtype=np.float32) / np.float32(255)
        return [
            _decode_output(output, self._kinds, score_floor, multi_label)
            for first in range(0, len(scaled), BATCHES["yolo"])
            for output in self._run(scaled[first : first + BATCHES["yolo"]])
        ]

    def _run(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return outputs (N, 4 + K, locations) of images that are not too many."""
        outputs = self.weights.run(images)
        expected = (len(images), 4 + len(self._kinds))
        if outputs.ndim != 3 or outputs.shape[:2] != expected or not 1 <= outputs.shape[2] <= MAX_LOCATIONS:
            what = f"boxes of {len(self._kinds)} kinds"
            raise WeightsError(f"{self.weights.path} gives {outputs.shape}, not {what}: it is no detector")
        if outputs[:, 4:].max() > 1:
            raise WeightsError(f"{self.weights.path} gives scores above 1: it is no detector")
        return outputs


def _decode_output(
    output: NDArray[np.float32], kinds: NDArray[np.intp], score_floor: float, multi_label: bool
) -> Boxes:
    """Return candidates of one image from output (4 + K, N): centre, size, scores of the K ``kinds``.

    Boxes that do not meet the tile, or reach far beyond it, bound nothing, and are left out.
    """
    output = output[:, _is_possible(output[:4])]
    scores = output[4:]
    if multi_label:
        kind, location = np.nonzero(scores >= score_floor)
    else:
        best = scores.argmax(axis=0)
        location = np.flatnonzero(scores[best, np.arange(scores.shape[1])] >= score_floor)
        kind = best[location]
    score = scores[kind, location]
    centre, half = output[0:2, location].T, output[2:4, location].T / 2
    return Boxes(np.concatenate((centre - half, centre + half), axis=1), kinds[kind], score)


def _is_possible(boxes: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which boxes (4, N), centre and size, meet their tile and do not reach far beyond it."""
    size, reach = boxes[2:], TILE_SIZE + 2 * MAX_REACH
    half = np.clip(size, 0, reach) / 2
    low, high = np.clip(boxes[:2], -reach, reach) - half, np.clip(boxes[:2], -reach, reach) + half
    inside = (low < TILE_SIZE) & (high > 0) & (low >= -MAX_REACH) & (high <= TILE_SIZE + MAX_REACH)
    return np.asarray((inside & (size > 0)).all(axis=0), dtype=np.bool_)


def box_iou(box: BoxArray, others: BoxArray) -> NDArray[np.float32]:
    """Compute the intersection over union of one box with others.

    Args:
        box: (4,).
        others: (N, 4).

    Returns:
        (N,), 0 to 1.
    """
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1)
    return np.asarray(shared / np.maximum((box[2:] - box[:2]).prod() + areas - shared, 1e-9), dtype=np.float32)


def non_maximum_suppression(
    boxes: Boxes,
    max_iou: float,
    per_kind: bool = False,
    eligible: NDArray[np.bool_] | None = None,
    hash_above: int = 3000,
) -> NDArray[np.intp]:
    """Suppress candidates that overlap a better one: greedy, in descending order of score.

    Args:
        boxes: The candidates (N).
        max_iou: Largest intersection over union with a better candidate that stays.
        per_kind: Whether a candidate is suppressed by candidates of its own kind only.
        eligible: (N,) which candidates take part; None: all.
        hash_above: With more candidates than this, each is compared with those nearby only (spatial hashing); the
            result is the same. Set by hand.

    Returns:
        (N,) for each candidate the index of the one that suppresses it, its own where it stays, -1 where it is not
        eligible.
    """
    suppressor = np.full(len(boxes), -1, np.intp)
    order = np.argsort(-boxes.score, kind="stable")
    if eligible is not None:
        order = order[eligible[order]]
    if len(order) > hash_above:
        return _suppress_hashed(boxes, max_iou, per_kind, order, suppressor)
    while len(order):
        best, rest = order[0], order[1:]
        suppressor[best] = best
        overlapping = box_iou(boxes.box[best], boxes.box[rest]) > max_iou
        if per_kind:
            overlapping &= boxes.kind[rest] == boxes.kind[best]
        suppressor[rest[overlapping]] = best
        order = rest[~overlapping]
    return suppressor


def _suppress_hashed(
    boxes: Boxes, max_iou: float, per_kind: bool, order: NDArray[np.intp], suppressor: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Suppress as :func:`non_maximum_suppression`, comparing boxes in neighbouring buckets of the plane only."""
    side = float((boxes.box[order, 2:] - boxes.box[order, :2]).max())
    buckets = np.floor(boxes.box[:, :2] / max(side, 1.0)).astype(int).tolist()
    kept: dict[tuple[int, int], list[int]] = {}
    for i in order.tolist():
        col, row = buckets[i]
        near = [k for c in (-1, 0, 1) for r in (-1, 0, 1) for k in kept.get((col + c, row + r), ())]
        if per_kind:
            near = [k for k in near if boxes.kind[k] == boxes.kind[i]]
        overlapping = np.flatnonzero(box_iou(boxes.box[i], boxes.box[near]) > max_iou) if near else ()
        if len(overlapping):
            suppressor[i] = max((near[k] for k in overlapping), key=lambda k: boxes.score[k])
        else:
            suppressor[i] = i
            kept.setdefault((col, row), []).append(i)
    return suppressor
