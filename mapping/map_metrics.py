"""How well a map agrees with the true cells."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from mapping.morphology import dilate
from prim.arrays import BoolGrid
from prim.metrics import f1_score, share_of_all

TOLERANCE_CELLS = 1
"""How far (cells, 8 neighbours) an occupied cell may lie from the truth's and still count."""


@dataclass(frozen=True, slots=True)
class MapScores:
    """How a map's cells agree with the truth's; a score is None where it has no cells to count."""

    occupied_precision: float | None
    occupied_recall: float | None
    occupied_f1: float | None
    free_accuracy: float | None
    auc: float | None

    def to_json(self) -> dict[str, float | None]:
        """As the report holds them."""
        return asdict(self)


def map_scores(
    probability: NDArray[np.floating],
    occupied: BoolGrid,
    free: BoolGrid,
    tolerance: int = TOLERANCE_CELLS,
) -> MapScores:
    """Scores of a map against the cells that are truly ``occupied`` and truly ``free``, all (rows, cols).

    The map calls a cell occupied where its probability is above 0.5 and free where it is below. Precision: of
    the cells called occupied that are truly occupied (within ``tolerance`` cells, 8 neighbours) or truly free,
    the share of the former; cells that no beam can reach do not count. Recall: the share of truly occupied
    cells with one called occupied within the tolerance. Free accuracy: the share of truly free cells called
    free. AUC: the chance that a truly occupied cell has a higher probability than a truly free one.
    """
    called = probability > 0.5
    near_truth = dilate(occupied, tolerance)
    right = np.count_nonzero(called & near_truth)
    wrong = np.count_nonzero(called & free & ~near_truth)
    precision = share_of_all(right, right + wrong)
    recall = share_of_all(np.count_nonzero(occupied & dilate(called, tolerance)), np.count_nonzero(occupied))
    return MapScores(
        occupied_precision=precision,
        occupied_recall=recall,
        occupied_f1=None if recall is None else f1_score(precision or 0.0, recall),
        free_accuracy=share_of_all(np.count_nonzero(free & (probability < 0.5)), np.count_nonzero(free)),
        auc=_auc(probability[occupied], probability[free]),
    )


def _auc(occupied: NDArray[np.floating], free: NDArray[np.floating]) -> float | None:
    """Area under the ROC curve: the Mann-Whitney statistic, ties counted half."""
    if not len(occupied) or not len(free):
        return None
    ranked = np.sort(free)
    below = np.searchsorted(ranked, occupied, side="left").mean()
    not_above = np.searchsorted(ranked, occupied, side="right").mean()
    return float((below + not_above) / (2 * len(free)))
