"""The metrics of Table I, on cases that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.evaluation.box_metrics import score_boxes
from detect.networks.yolo import Boxes
from detect.training.matches import ScoredBoxes
from detect.training.thresholds import best_confidences

SQUARE, CIRCLE = 0, 2


def scored_boxes(
    candidates: list[tuple[tuple[float, ...], int, float]], truths: list[tuple[tuple[float, ...], int]]
) -> ScoredBoxes:
    return ScoredBoxes(
        Boxes(
            np.array([box for box, _, _ in candidates], np.float32).reshape(-1, 4),
            np.array([kind for _, kind, _ in candidates], dtype=np.intp),
            np.array([score for _, _, score in candidates], np.float32),
        ),
        np.array([box for box, _ in truths], np.float32).reshape(-1, 4),
        np.array([kind for _, kind in truths], dtype=np.intp),
    )


A, B, FAR = (0, 0, 10, 10), (20, 20, 40, 40), (100, 100, 110, 110)


def test_perfect_candidates_score_one() -> None:
    image = scored_boxes([(A, SQUARE, 0.9), (B, CIRCLE, 0.7)], [(A, SQUARE), (B, CIRCLE)])
    scores = score_boxes([image])
    assert set(scores) == {"all", "square", "circle"}
    for row in scores.values():
        assert (row.f1, row.map50, row.map50_95, row.auc) == pytest.approx((1, 1, 1, 1))
    assert 0.0 < best_confidences([image])["square"] <= 0.9


def test_no_candidates_score_zero_and_absent_kinds_have_no_row() -> None:
    assert score_boxes([scored_boxes([(A, SQUARE, 0.9)], [])]) == {}
    row = score_boxes([scored_boxes([], [(A, SQUARE)])])["all"]
    assert (row.f1, row.map50, row.map50_95, row.auc) == (0, 0, 0, 0)


def test_wrong_kinds_duplicates_and_strays_are_false_positives() -> None:
    image = scored_boxes(
        [(A, SQUARE, 0.9), (A, SQUARE, 0.8), (B, SQUARE, 0.7), (FAR, SQUARE, 0.6)], [(A, SQUARE), (B, CIRCLE)]
    )
    scores = score_boxes([image])
    assert scores["square"].f1 == pytest.approx(1.0)  # at a confidence between 0.8 and 0.9
    assert scores["circle"].map50 == 0
    assert scores["all"].map50 == pytest.approx((scores["square"].map50 + scores["circle"].map50) / 2)


def test_average_precision_by_hand() -> None:
    """Hit, miss, hit of two true boxes: precision 1, 1/2, 2/3 at recall 1/2, 1/2, 1."""
    image = scored_boxes([(A, SQUARE, 0.9), (FAR, SQUARE, 0.8), (B, SQUARE, 0.7)], [(A, SQUARE), (B, SQUARE)])
    row = score_boxes([image])["square"]
    assert row.auc == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    assert row.map50 == pytest.approx((51 * 1 + 50 * 2 / 3) / 101)
    assert row.f1 == pytest.approx(0.8)


def test_a_loose_box_is_a_match_at_low_iou_only() -> None:
    image = scored_boxes([((0, 0, 10, 8), SQUARE, 0.9)], [(A, SQUARE)])  # IoU 0.8
    row = score_boxes([image])["square"]
    assert row.map50 == 1 and row.map50_95 == pytest.approx(0.7)


def test_the_candidate_with_the_larger_score_is_matched_first() -> None:
    """Two candidates on one true box: the better one is matched though the worse overlaps more."""
    image = scored_boxes([((0, 0, 10, 8), SQUARE, 0.9), (A, SQUARE, 0.5)], [(A, SQUARE)])
    assert score_boxes([image])["square"].auc == 1


@given(st.lists(st.tuples(st.booleans(), st.floats(0.01, 1)), min_size=1, max_size=30), st.integers(0, 5))
def test_metrics_are_between_zero_and_one(found: list[tuple[bool, float]], missed: int) -> None:
    """For any order of hits and misses; the interpolated area is hardly below the raw one."""
    candidates, truths = [], []
    for k, (hit, score) in enumerate(found):
        box = (30.0 * k, 0.0, 30.0 * k + 10, 10.0)
        candidates.append((box, SQUARE, score))
        if hit:
            truths.append((box, SQUARE))
    truths += [((30.0 * k, 50.0, 30.0 * k + 10, 60.0), SQUARE) for k in range(missed + 1)]
    row = score_boxes([scored_boxes(candidates, truths)])["square"]
    for value in (row.f1, row.map50, row.map50_95, row.auc):
        assert 0 <= value <= 1
    assert row.map50 >= row.auc - 0.02
