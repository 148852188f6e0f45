"""Metrics of boxes: those of the paper's Table I."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detect.networks.yolo import KINDS
from detect.training.matches import MATCH_IOUS, KindMatches, ScoredBoxes, match_kind, peak_confidence

RECALLS = np.linspace(0, 1, 101)
"""Recalls that the interpolated precision is read at (COCO)."""


@dataclass(frozen=True)
class BoxMetrics:
    """A row of Table I; the fields are the keys of results.

    Attributes:
        f1: Largest F1 over all score thresholds, at a match IoU of 0.5.
        map50: Mean average precision at a match IoU of 0.5.
        map50_95: Its mean over MATCH_IOUS.
        auc: Area under the precision-recall curve at a match IoU of 0.5, without interpolation.
        confidence: Score threshold of the largest F1.
    """

    f1: float
    map50: float
    map50_95: float
    auc: float
    confidence: float


def score_boxes(images: Sequence[ScoredBoxes]) -> dict[str, BoxMetrics]:
    """Compute the metrics of each kind that occurs, by name, and of ``all``: the mean over these kinds.

    F1 of ``all`` is the largest mean over the kinds at a common score threshold. See :func:`match_kind` for what is a
    true positive.
    """
    matches = {kind: match_kind(images, index) for index, kind in enumerate(KINDS)}
    matches = {kind: own for kind, own in matches.items() if own.truths}
    if not matches:
        return {}
    rows = {kind.value: _metrics([own]) for kind, own in matches.items()}
    return {"all": _metrics(list(matches.values()))} | rows


def average_precision(matches: KindMatches, column: int) -> float:
    """Compute the average precision: the upper envelope of precision over recall, read at RECALLS.

    Args:
        matches: One kind's candidates.
        column: Index of the match IoU in MATCH_IOUS.

    Returns:
        The average precision, 0 to 1.
    """
    precision, recall = matches.precision_recall(column)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, RECALLS - 1e-12)
    return float(np.append(envelope, 0.0)[np.minimum(at, len(envelope))].mean())


def precision_recall_area(matches: KindMatches) -> float:
    """Compute the area under precision over recall at a match IoU of 0.5, without interpolation."""
    precision, recall = matches.precision_recall(0)
    return float((precision * np.diff(recall, prepend=0.0)).sum())


def _metrics(kinds: Sequence[KindMatches]) -> BoxMetrics:
    """Compute the metrics of some kinds together: means over them."""
    f1 = np.mean([matches.f1() for matches in kinds], axis=0)
    precisions = np.array([[average_precision(matches, k) for k in range(len(MATCH_IOUS))] for matches in kinds])
    area = float(np.mean([precision_recall_area(matches) for matches in kinds]))
    map50, map50_95 = float(precisions[:, 0].mean()), float(precisions.mean())
    return BoxMetrics(float(f1.max()), map50, map50_95, area, peak_confidence(f1))
