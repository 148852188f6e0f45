"""Scores of a map against a reference map's cells."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.morphology import dilate
from prim.arrays import BoolGrid
from prim.metrics import f1_score, ratio

TOLERANCE_CELLS = 1
"""How far (cells, 8 neighbours) an occupied cell may lie from a truly occupied one and still count as right."""


@dataclass(frozen=True, slots=True)
class MapScores:
    """Scores of a map, see :func:`map_scores`; None where there are no cells to count."""

    occupied_precision: float | None
    occupied_recall: float | None
    occupied_f1: float | None
    free_accuracy: float | None
    auc: float | None

    def to_json(self) -> dict[str, float | None]:
        """Return the scores as the report holds them."""
        return asdict(self)


def map_scores(
    probability: NDArray[np.floating],
    occupied: BoolGrid,
    free: BoolGrid,
    tolerance: int = TOLERANCE_CELLS,
) -> MapScores:
    """Score a map against the truly occupied and truly free cells.

    The map calls a cell occupied where its probability is above 0.5 and free where it is below. Precision: of the
    cells called occupied that are truly occupied (within the tolerance) or truly free, the share of the former; cells
    that no beam can reach do not count. Recall: the share of truly occupied cells with a cell called occupied within
    the tolerance. Free accuracy: the share of truly free cells called free. AUC: the probability that a truly
    occupied cell has a higher probability than a truly free one.

    Args:
        probability: The map's probabilities of occupancy (rows, cols).
        occupied: Truly occupied cells (rows, cols).
        free: Truly free cells (rows, cols).
        tolerance: Tolerance of precision and recall (cells, 8 neighbours).

    Returns:
        The scores.
    """
    called = probability > 0.5
    near_truth = dilate(occupied, tolerance)
    right = np.count_nonzero(called & near_truth)
    wrong = np.count_nonzero(called & free & ~near_truth)
    precision = ratio(right, right + wrong)
    recall = ratio(np.count_nonzero(occupied & dilate(called, tolerance)), np.count_nonzero(occupied))
    return MapScores(
        occupied_precision=precision,
        occupied_recall=recall,
        occupied_f1=None if recall is None else f1_score(precision or 0.0, recall),
        free_accuracy=ratio(np.count_nonzero(free & (probability < 0.5)), np.count_nonzero(free)),
        auc=_auc(probability[occupied], probability[free]),
    )


def _auc(occupied: NDArray[np.floating], free: NDArray[np.floating]) -> float | None:
    """Return the area under the ROC curve: the Mann-Whitney statistic, ties counted half."""
    if not len(occupied) or not len(free):
        return None
    ranked = np.sort(free)
    below = np.searchsorted(ranked, occupied, side="left").mean()
    not_above = np.searchsorted(ranked, occupied, side="right").mean()
    return float((below + not_above) / (2 * len(free)))
