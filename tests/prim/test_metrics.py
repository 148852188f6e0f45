import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from mapping.map_metrics import map_scores
from prim.metrics import detection_errors, match_primitives, outline_overlap, polygon_iou, pose_rmse
from prim.shapes import Kind, Primitive


def circle(x: float, radius: float = 0.1) -> Primitive:
    return Primitive(Kind.CIRCLE, x, 0.0, None, (radius,))


def square(x: float, side: float, theta: float = 0.0) -> Primitive:
    return Primitive(Kind.SQUARE, x, 0.0, theta, (side,))


def test_iou_of_shifted_squares() -> None:
    assert polygon_iou(square(0, 1), square(0.5, 1)) == pytest.approx(0.5 / 1.5)
    assert polygon_iou(square(0, 1), square(5, 1)) == 0


@given(
    kind=st.sampled_from(Kind),
    theta=st.floats(0, 6.28),
    sizes=st.tuples(st.floats(0.05, 0.3), st.floats(0.05, 0.3)),
    moved=st.floats(-1e-8, 1e-8),
)
def test_nearly_coincident_shapes_overlap_in_full(
    kind: Kind, theta: float, sizes: tuple[float, float], moved: float
) -> None:
    shape = Primitive(kind, 0.3, -0.2, None if kind is Kind.CIRCLE else theta, sizes[: len(kind.sizes)]).canonical()
    assert polygon_iou(shape, replace(shape, x=shape.x + moved)) > 0.9999


def test_triangles_that_differ_by_rounding_overlap_in_full() -> None:
    one, other = (
        Primitive(Kind.TRIANGLE, 0.3, -0.2, 2.3597942834000514, (base, 0.2021093395771307))
        for base in (0.20226531937725828, 0.2022653193772583)
    )
    assert polygon_iou(one, other) > 0.9999


def test_outlines_overlap_by_what_they_enclose() -> None:
    corner = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]])
    box = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    assert outline_overlap(corner, box) == outline_overlap(box, corner) == pytest.approx(1)
    assert outline_overlap(corner, box + 1.5) == 0  # within its hull alone
    assert outline_overlap(corner, box + 0.5) == pytest.approx(0.75)
    crossing = np.array([[0.0, 0.0], [2.0, 2.0], [2.0, 0.0], [0.0, 2.0]])  # two triangles of area 1
    assert outline_overlap(crossing, box) == pytest.approx(0.5)
    assert outline_overlap(box, np.zeros((3, 2))) == 0


def test_perfect_detections_have_no_errors() -> None:
    truth = [circle(0), square(1, 0.2)]
    errors = detection_errors(truth[::-1], truth)
    assert (errors.precision, errors.recall, errors.f1, errors.iou) == pytest.approx((1, 1, 1, 1))
    assert (errors.position, errors.angle, errors.width, errors.height) == pytest.approx((0, 0, 0, 0))
    assert {(pair.detection, pair.truth) for pair in errors.pairs} == {(0, 1), (1, 0)}


def test_errors_are_the_papers_means_over_true_positives() -> None:
    truth = [circle(0, 0.10), circle(1, 0.20), square(2, 0.2)]
    found = [circle(0.01, 0.11), circle(1.03, 0.20), circle(2, 0.1)]
    errors = detection_errors(found, truth)
    assert errors.precision == pytest.approx(2 / 3)
    assert errors.recall == pytest.approx(2 / 3)
    assert errors.position == pytest.approx(0.02)
    assert errors.width == pytest.approx(0.005)
    assert errors.angle is None
    wrong = [pair for pair in errors.pairs if not pair.same_kind]
    assert [(pair.detection, pair.truth) for pair in wrong] == [(2, 2)]


def test_one_of_two_detections_of_one_primitive_is_a_true_positive() -> None:
    errors = detection_errors([circle(0.01), circle(0.0)], [circle(0.0)])
    assert (errors.precision, errors.recall) == (0.5, 1.0)
    assert errors.pairs[0].detection == 1


def test_an_equal_kind_is_preferred_to_a_larger_overlap() -> None:
    detections, truth = [square(0, 0.19), circle(0.03)], [circle(0.0)]
    assert polygon_iou(detections[0], truth[0]) > polygon_iou(detections[1], truth[0]) > 0.5
    pairs = match_primitives(detections, truth)
    assert pairs[0].detection == 1


@pytest.mark.parametrize(("detections", "truth", "f1"), [(0, 0, 1.0), (0, 1, 0.0), (1, 0, 0.0)])
def test_nothing_found_or_nothing_there(detections: int, truth: int, f1: float) -> None:
    assert detection_errors([circle(0)] * detections, [circle(0)] * truth).f1 == f1


def test_map_scores_agree_with_hand_counts() -> None:
    """A row of cells: free free free occupied hidden; the map is off by one cell and has one false alarm."""
    occupied = np.array([[False, False, False, False, True, False]])
    free = np.array([[True, True, True, False, False, False]])
    called = np.array([[0.9, 0.1, 0.5, 0.8, 0.2, 0.9]], dtype=np.float32)
    scores = map_scores(called, occupied, free)
    assert scores.occupied_precision == pytest.approx(2 / 3)  # cells 3 and 5 lie within one cell; 0 is free
    assert scores.occupied_recall == 1
    assert scores.occupied_f1 == pytest.approx(0.8)
    assert scores.free_accuracy == pytest.approx(1 / 3)
    assert scores.auc == pytest.approx(1 / 3)  # 0.2 against 0.9, 0.1 and 0.5


def test_cells_that_no_beam_reaches_do_not_count() -> None:
    nowhere = np.zeros((3, 3), dtype=bool)
    scores = map_scores(np.ones((3, 3), dtype=np.float32), nowhere, nowhere)
    assert set(scores.to_json().values()) == {None}


def test_an_unknown_map_has_no_recall() -> None:
    occupied = np.eye(4, dtype=bool)
    scores = map_scores(np.full((4, 4), 0.5, dtype=np.float32), occupied, ~occupied)
    assert scores.occupied_precision is None
    assert (scores.occupied_recall, scores.occupied_f1, scores.free_accuracy) == (0, 0, 0)
    assert scores.auc == 0.5


def test_pose_rmse_wraps_the_heading() -> None:
    metres, radians = pose_rmse(np.array([[3.0, 4.0, math.pi - 0.01]]), np.array([[0.0, 0.0, -math.pi + 0.01]]))
    assert metres == pytest.approx(5)
    assert radians == pytest.approx(0.02)


def test_circle_outline_covers_its_area() -> None:
    assert shapely.Polygon(circle(0).outline()).area == pytest.approx(math.pi * 0.01, rel=1e-3)
