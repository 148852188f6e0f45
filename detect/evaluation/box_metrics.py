"""How good boxes are: the measures of the paper's Table I."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.networks.yolo import KINDS, BoxArray, Boxes, overlap

IOUS = np.round(np.arange(0.5, 1.0, 0.05), 2)
"""The least IoUs that mAP 0.5-0.95 is the mean over; the first alone is mAP 0.5's."""

RECALLS = np.linspace(0, 1, 101)
"""Where the interpolated precision is read, as COCO does."""

CONFIDENCES = np.linspace(0, 1, 1001)
"""The confidences among which F1 is largest."""


@dataclass(frozen=True)
class Marked:
    """One image's candidates, and its true boxes (N, 4) with their kinds (N,), indices of KINDS."""

    boxes: Boxes
    true_box: BoxArray
    true_kind: NDArray[np.intp]


@dataclass(frozen=True)
class Scores:
    """A row of Table I. ``f1`` is the largest over all confidences, reached at ``confidence``, at an IoU of 0.5.

    ``map50``: mean average precision at IoU 0.5; ``map50_95``: the mean over IOUS; ``auc``: the area under the
    precision-recall curve at IoU 0.5 as it is, where the average precision takes its upper envelope.
    """

    f1: float
    map50: float
    map50_95: float
    auc: float
    confidence: float


@dataclass(frozen=True)
class _Curve:
    """What one kind's candidates are worth, best first: scores (N,), hits (N, len(IOUS)); true primitives."""

    score: NDArray[np.float32]
    hit: NDArray[np.bool_]
    truths: int

    def f1(self) -> NDArray[np.float64]:
        """F1 at IoU 0.5 where only candidates of each of CONFIDENCES and more count."""
        taken = np.searchsorted(-self.score, -CONFIDENCES, side="right")
        hits = np.concatenate(([0], np.cumsum(self.hit[:, 0])))[taken]
        return np.asarray(2 * hits / np.maximum(taken + self.truths, 1), dtype=np.float64)

    def precision_recall(self, column: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        hits = np.cumsum(self.hit[:, column])
        return hits / np.arange(1, len(hits) + 1), hits / max(self.truths, 1)

    def average_precision(self, column: int) -> float:
        """The upper envelope of precision, read at RECALLS."""
        precision, recall = self.precision_recall(column)
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        at = np.searchsorted(recall, RECALLS - 1e-12)
        return float(np.append(envelope, 0.0)[np.minimum(at, len(envelope))].mean())

    def area(self) -> float:
        """Under precision over recall at IoU 0.5."""
        precision, recall = self.precision_recall(0)
        return float((precision * np.diff(recall, prepend=0.0)).sum())


def score_boxes(images: Sequence[Marked]) -> dict[str, Scores]:
    """Scores of each kind that occurs, and of ``all``: the mean over these kinds.

    F1 of all is the largest mean over the kinds at one confidence. A candidate hits a true box of its kind that it
    overlaps enough and that no better candidate has hit; it takes the one it overlaps most.
    """
    curves = {kind: _curve(images, index) for index, kind in enumerate(KINDS)}
    curves = {kind: curve for kind, curve in curves.items() if curve.truths}
    if not curves:
        return {}
    rows = {kind.value: _scores([curve]) for kind, curve in curves.items()}
    return {"all": _scores(list(curves.values()))} | rows


def best_confidences(images: Sequence[Marked]) -> dict[str, float]:
    """For each kind that occurs the confidence of its largest F1 at IoU 0.5: the middle of where it is largest."""
    found: dict[str, float] = {}
    for index, kind in enumerate(KINDS):
        curve = _curve(images, index)
        if curve.truths:
            found[kind.value] = _peak(curve.f1())
    return found


def _scores(curves: Sequence[_Curve]) -> Scores:
    f1 = np.mean([curve.f1() for curve in curves], axis=0)
    precisions = np.array([[curve.average_precision(k) for k in range(len(IOUS))] for curve in curves])
    area = float(np.mean([curve.area() for curve in curves]))
    return Scores(float(f1.max()), float(precisions[:, 0].mean()), float(precisions.mean()), area, _peak(f1))


def _peak(f1: NDArray[np.float64]) -> float:
    return float(np.median(CONFIDENCES[f1 >= f1.max() - 1e-9]))


def _curve(images: Sequence[Marked], index: int) -> _Curve:
    """Hits of one kind's candidates over all images."""
    score, hit = [np.empty(0, np.float32)], [np.empty((0, len(IOUS)), bool)]
    truths = 0
    for image in images:
        true_box = image.true_box[image.true_kind == index]
        truths += len(true_box)
        own = image.boxes[np.flatnonzero(image.boxes.kind == index)]
        own = own[np.argsort(-own.score, kind="stable")]
        score.append(own.score)
        hit.append(_hits(own.box, true_box))
    scores = np.concatenate(score)
    order = np.argsort(-scores, kind="stable")
    return _Curve(scores[order], np.concatenate(hit)[order], truths)


def _hits(box: BoxArray, true_box: BoxArray) -> NDArray[np.bool_]:
    """Which candidates (N, 4), best first, hit a true box, at each of IOUS: (N, len(IOUS))."""
    hit = np.zeros((len(box), len(IOUS)), bool)
    if not len(true_box):
        return hit
    shared = np.array([overlap(one, true_box) for one in box]).reshape(len(box), len(true_box))
    for column, least in enumerate(IOUS):
        free = np.ones(len(true_box), bool)
        for i, row in enumerate(shared):
            best = int(np.argmax(np.where(free, row, -1.0)))
            if free[best] and row[best] >= least:
                hit[i, column], free[best] = True, False
    return hit
