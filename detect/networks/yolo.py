"""YOLO on ONNX Runtime: images to boxes with kinds and scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.networks.tiles import TILE
from detect.networks.weights import Weights, WeightsError
from prim.shapes import Kind

KINDS = tuple(Kind)
"""The classes' order."""

CHANNELS = 3

MANY = 3000
"""From so many candidates on, suppression looks at neighbours only."""

BoxArray = NDArray[np.float32]
"""(N, 4): left, top, right, bottom in cells; row 0 at the top."""


@dataclass(frozen=True)
class Boxes:
    """Candidates of one image: ``box`` (N, 4), ``kind`` (N,) as an index of KINDS, ``score`` (N,)."""

    box: BoxArray
    kind: NDArray[np.intp]
    score: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.score)

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Boxes:
        return Boxes(self.box[chosen], self.kind[chosen], self.score[chosen])

    def moved(self, cols: int, rows: int) -> Boxes:
        """The same, moved by whole cells."""
        return Boxes(self.box + np.array([cols, rows, cols, rows], np.float32), self.kind, self.score)

    @classmethod
    def joined(cls, parts: Sequence[Boxes]) -> Boxes:
        """All parts, one after the other."""
        if not parts:
            return cls(np.empty((0, 4), np.float32), np.empty(0, np.intp), np.empty(0, np.float32))
        box, kind, score = ([getattr(part, name) for part in parts] for name in ("box", "kind", "score"))
        return cls(np.concatenate(box), np.concatenate(kind), np.concatenate(score))


class Yolo:
    """A network that finds primitives in tiles.

    Raises WeightsError where the network does not take tiles or does not give the kinds of its card.
    """

    def __init__(self, weights: Weights) -> None:
        self.weights = weights
        self._input = weights.session.get_inputs()[0].name
        shape = self._run(np.zeros((1, CHANNELS, TILE, TILE), np.float32)).shape
        self._kinds = np.array([KINDS.index(Kind(name)) for name in weights.card.kinds], np.intp)
        if len(shape) != 3 or shape[1] != 4 + len(self._kinds):
            wanted = f"boxes of {len(self._kinds)} kinds"
            raise WeightsError(f"{weights.path} gives {shape}, not {wanted}: it is no detector")

    def __call__(self, images: NDArray[np.uint8], floor: float, every_kind: bool = False) -> list[Boxes]:
        """What may be in images (N, TILE, TILE, 3): candidates with a score of ``floor`` or more.

        A place is one candidate, of its likeliest kind; with ``every_kind`` one for each kind, as YOLOv5's own
        evaluation has it. Many candidates lie on each other: see :func:`suppress`.
        """
        scaled = np.ascontiguousarray(images.transpose(0, 3, 1, 2), dtype=np.float32) / np.float32(255)
        return [_candidates(output, self._kinds, floor, every_kind) for output in self._run(scaled)]

    def _run(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        try:
            return np.asarray(self.weights.session.run(None, {self._input: images})[0], dtype=np.float32)
        except Exception as error:  # ONNX Runtime raises many kinds, none of them documented
            wanted = f"images of {CHANNELS} x {TILE} x {TILE}"
            raise WeightsError(f"{self.weights.path} does not take {wanted}: it is no detector") from error


def _candidates(output: NDArray[np.float32], kinds: NDArray[np.intp], floor: float, every_kind: bool) -> Boxes:
    """Boxes of one image from the network's output (4 + K, anchors): centre, size, scores of the K ``kinds``."""
    scores = output[4:]
    if every_kind:
        kind, anchor = np.nonzero(scores >= floor)
    else:
        best = scores.argmax(axis=0)
        anchor = np.flatnonzero(scores[best, np.arange(scores.shape[1])] >= floor)
        kind = best[anchor]
    score = scores[kind, anchor]
    centre, half = output[0:2, anchor].T, output[2:4, anchor].T / 2
    return Boxes(np.concatenate((centre - half, centre + half), axis=1), kinds[kind], score)


def overlap(box: BoxArray, others: BoxArray) -> NDArray[np.float32]:
    """Intersection over union of one box (4,) with others (N, 4)."""
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    shared = np.clip(high - low, 0, None).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1)
    return np.asarray(shared / np.maximum((box[2:] - box[:2]).prod() + areas - shared, 1e-9), dtype=np.float32)


def suppress(
    boxes: Boxes, limit: float, per_kind: bool = False, among: NDArray[np.bool_] | None = None
) -> NDArray[np.intp]:
    """By which better candidate each is suppressed (N,): its index; its own where it stays.

    Greedy, best first: what overlaps a better one by more than ``limit`` (IoU) goes; with ``per_kind`` only where
    both are of one kind. Candidates that are not ``among`` take no part, and have -1.
    """
    by = np.full(len(boxes), -1, np.intp)
    order = np.argsort(-boxes.score, kind="stable")
    if among is not None:
        order = order[among[order]]
    if len(order) > MANY:
        return _suppress_many(boxes, limit, per_kind, order, by)
    while len(order):
        best, rest = order[0], order[1:]
        by[best] = best
        gone = overlap(boxes.box[best], boxes.box[rest]) > limit
        if per_kind:
            gone &= boxes.kind[rest] == boxes.kind[best]
        by[rest[gone]] = best
        order = rest[~gone]
    return by


def _suppress_many(
    boxes: Boxes, limit: float, per_kind: bool, order: NDArray[np.intp], by: NDArray[np.intp]
) -> NDArray[np.intp]:
    """The same for so many that not each can be held against all: only what lies near is looked at."""
    side = float((boxes.box[order, 2:] - boxes.box[order, :2]).max())
    places = np.floor(boxes.box[:, :2] / max(side, 1.0)).astype(int).tolist()
    kept: dict[tuple[int, int], list[int]] = {}
    for i in order.tolist():
        col, row = places[i]
        near = [k for c in (-1, 0, 1) for r in (-1, 0, 1) for k in kept.get((col + c, row + r), ())]
        if per_kind:
            near = [k for k in near if boxes.kind[k] == boxes.kind[i]]
        over = np.flatnonzero(overlap(boxes.box[i], boxes.box[near]) > limit) if near else ()
        if len(over):
            by[i] = max((near[k] for k in over), key=lambda k: boxes.score[k])
        else:
            by[i] = i
            kept.setdefault((col, row), []).append(i)
    return by
