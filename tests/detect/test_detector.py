"""The detector, with fake networks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.detector import Detector
from detect.networks.cnn import ParameterEstimator
from detect.networks.tiles import TILE_SIZE
from detect.networks.weights import KIND_NAMES, ModelCard, WeightsError
from detect.networks.yolo import Boxes, Yolo, non_maximum_suppression
from mapping.grid import GridFrame, OccupancyGrid
from prim.metrics import polygon_iou
from prim.shapes import Kind
from tests.detect.fakes import blobs, constant, weights

CIRCLE_GREY = 0.8
"""Grey that the fake YOLO detects as a circle."""


def detector(thresholds: dict[str, float] | None = None) -> Detector:
    yolo = weights(ModelCard("yolo", "det", thresholds=thresholds or {}), blobs)
    # every kind: angle 0 (cosine 1, sine 0), offset (0.04, -0.02) m, sizes 0.2 and 0.1 m
    outputs = (
        [1, 0, 0.1, -0.05, 0.5]
        + [1, 0, 0.1, -0.05, 0.5, 0.25]
        + [0.1, -0.05, 0.25]
        + 2 * [1, 0, 0.1, -0.05, 0.5, 0.25]
    )
    return Detector(yolo, [constant("prim", KIND_NAMES, outputs)])


def grid_with(*centres: tuple[float, float], rows: int = 220, cols: int = 220, half: int = 10) -> OccupancyGrid:
    """A free map whose first cell lies at (0, 0), with solid blobs that are detected as circles."""
    probability = np.full((rows, cols), 0.1, np.float32)
    for x, y in centres:
        row, col = round(y * 100), round(x * 100)
        probability[row - half : row + half, col - half : col + half] = CIRCLE_GREY
    return OccupancyGrid(GridFrame(0.01, 0, 0, rows, cols), probability)


def test_a_blob_is_detected_where_it_lies() -> None:
    (detection,) = detector().detect(grid_with((0.7, 1.3))).found
    primitive = detection.primitive
    assert primitive.kind is Kind.CIRCLE and detection.score == pytest.approx(0.9)
    assert (primitive.x, primitive.y) == pytest.approx((0.7 + 0.04, 1.3 - 0.02), abs=0.006)
    assert primitive.size == pytest.approx((0.1,))
    assert detection.crop.shape == (72, 72)


def test_candidates_below_the_threshold_are_doubtful() -> None:
    """The best of overlapping ones, with parameters and rejection; none beside a detection."""
    found = detector({"circle": 0.95}).detect(grid_with((0.7, 1.3)))
    ((doubtful, rejection),) = found.doubtful
    assert doubtful.score == pytest.approx(0.9) and rejection in found.rejected
    assert (doubtful.primitive.x, doubtful.primitive.y) == pytest.approx((0.7 + 0.04, 1.3 - 0.02), abs=0.006)
    assert detector({"circle": 0.3}).detect(grid_with((0.7, 1.3))).doubtful == ()


def test_rejections_name_the_failed_test() -> None:
    found = detector({"circle": 0.95}).detect(grid_with((0.7, 1.3)))
    assert not found.found
    low, lower = found.rejected
    assert low.reason == "score 0.90 is below 0.95, the least for a circle" and lower.score == pytest.approx(0.4)
    assert (low.x, low.y) == pytest.approx((0.7, 1.3), abs=0.006)
    (double,) = detector({"circle": 0.3}).detect(grid_with((0.7, 1.3))).rejected
    assert double.reason == "overlaps a better circle by more than 0.45 (IoU)"


def test_rejected_candidates_suppress_nothing() -> None:
    """A circle below its threshold overlaps an ellipse above its own: the ellipse is detected."""

    def answer(batch: np.ndarray) -> np.ndarray:
        output = np.zeros((len(batch), 9, 2), np.float32)
        output[:, :4] = np.array([50, 60, 20, 20], np.float32)[None, :, None]
        output[:, 4 + 2, 0], output[:, 4 + 4, 1] = 0.55, 0.5
        return output

    made = detector()
    made.yolo = Yolo(weights(ModelCard("yolo", "det"), answer))
    made.thresholds |= {Kind.CIRCLE: 0.6, Kind.ELLIPSE: 0.3}
    found = made.detect(grid_with((0.7, 1.3)), (0.05, 0.3))
    assert [detection.primitive.kind for detection in found.found] == [Kind.ELLIPSE]
    assert [rejection.reason[:10] for rejection in found.rejected] == ["score 0.55"]


def test_a_primitive_in_two_tiles_is_detected_once() -> None:
    """The map has several tiles, which overlap."""
    rows, cols = TILE_SIZE, 2 * TILE_SIZE - 64
    for x in (1.7, 1.92, 1.62, 2.2):
        found = detector().detect(grid_with((x, 1.0), rows=rows, cols=cols))
        assert len(found.found) == 1
        assert found.found[0].primitive.x == pytest.approx(x + 0.04, abs=0.006)


def test_a_large_map_is_processed_in_batches() -> None:
    made = detector()
    centres = [(x, y) for x in np.arange(0.5, 11.5, 2.2) for y in np.arange(0.5, 8.5, 2.2)]
    session = made.yolo.weights.session
    session.batches.clear()  # type: ignore[attr-defined]
    made.detect(grid_with(*centres, rows=900, cols=1200))
    batches = session.batches  # type: ignore[attr-defined]
    assert len(batches) > 1 and max(batches) <= made.options.batch_size


@pytest.mark.parametrize("value", [0.5, 0.1])
def test_no_network_runs_on_an_empty_map(value: float) -> None:
    """All unknown, or all free."""
    made = detector()
    session = made.yolo.weights.session
    session.batches.clear()  # type: ignore[attr-defined]
    found = made.detect(OccupancyGrid(GridFrame(0.01, -50, 7, 300, 500), np.full((300, 500), value, np.float32)))
    assert found.found == () and found.rejected == () and session.batches == []  # type: ignore[attr-defined]


@pytest.mark.parametrize("resolution", [0.005, 0.02, 0.05])
def test_networks_see_shapes_in_cells_of_any_size(resolution: float) -> None:
    """The same cells, of another size: the same primitive, larger or smaller; in the units of the map."""
    grid = grid_with((0.7, 1.3))
    scale = resolution / 0.01
    other = OccupancyGrid(replace(grid.frame, resolution=resolution), grid.probability)
    (before,) = detector().detect(grid, (0.05, 0.3)).found
    (after,) = detector().detect(other, (0.05 * scale, 0.3 * scale)).found
    a, b = before.primitive, after.primitive
    assert (b.x, b.y, *b.size) == pytest.approx([scale * value for value in (a.x, a.y, *a.size)])
    assert after.box == pytest.approx([scale * value for value in before.box]) and after.score == before.score


def test_large_things_are_detected_in_larger_cells() -> None:
    """A blob of 1.6 m has 40 cells in cells of 4 cm, where the fake network's 10 cells of radius are 0.4 m."""
    (found,) = detector().detect(grid_with((4.0, 4.0), rows=900, cols=900, half=80)).found
    assert found.primitive.x == pytest.approx(4.0 + 4 * 0.04, abs=0.01)
    assert found.primitive.width_height[0] == pytest.approx(4 * 0.1)
    (found,) = detector().detect(grid_with((4.0, 4.0), rows=900, cols=900)).found
    assert found.primitive.width_height[0] == pytest.approx(0.1)


def test_what_only_another_size_of_cells_shows_differently_is_a_rival() -> None:
    """Two boxes at one place that differ in size: the better one is found, and refinement decides between them."""
    grid = grid_with((1.0, 1.0), half=20)
    found = detector().detect(grid, (0.05, 2.0))
    assert len(found.found) == 1
    for rival, rejection in found.rivals:
        assert rejection in found.rejected
        assert polygon_iou(rival.primitive, found.found[0].primitive) < 0.8


def test_a_map_of_walls_is_searched_where_things_stand_isolated() -> None:
    """A large room with one thing in it: few tiles of many."""
    grid = grid_with((8.0, 5.0), rows=1200, cols=1600)
    probability = grid.probability.copy()
    probability[:5], probability[-5:], probability[:, :5], probability[:, -5:] = 4 * (CIRCLE_GREY,)
    made, seen = detector(), []
    made.detect(OccupancyGrid(grid.frame, probability), (0.05, 0.3), lambda done, total: seen.append((done, total)))
    assert seen == [(1, 1)]


def test_networks_that_contradict_their_model_card() -> None:
    with pytest.raises(WeightsError, match="no detector"):
        Yolo(weights(ModelCard("yolo", "det"), lambda batch: np.zeros((len(batch), 84, 10), np.float32)))
    with pytest.raises(WeightsError, match="1 x 3 numbers where its card says 1 x 5"):
        ParameterEstimator([constant("prim", ["square"], [1, 0, 0.5])])


def test_suppression_by_hand() -> None:
    boxes = Boxes(
        np.array([(0, 0, 10, 10), (1, 0, 11, 10), (20, 0, 30, 10), (0, 1, 10, 11)], np.float32),
        np.array([0, 0, 0, 1]),
        np.array([0.5, 0.9, 0.3, 0.8], np.float32),
    )
    assert non_maximum_suppression(boxes, 0.5).tolist() == [1, 1, 2, 1]
    assert non_maximum_suppression(boxes, 0.5, per_kind=True).tolist() == [1, 1, 2, 3]
    assert non_maximum_suppression(boxes, 0.5, eligible=np.array([True, False, True, True])).tolist() == [3, -1, 2, 3]


@given(st.integers(0, 2**31), st.booleans())
def test_many_are_suppressed_as_few_are(seed: int, per_kind: bool) -> None:
    rng = np.random.default_rng(seed)
    corner, side = rng.uniform(-200, 200, (60, 2)), rng.uniform(5, 60, (60, 2))
    boxes = Boxes(
        np.concatenate((corner, corner + side), axis=1).astype(np.float32),
        rng.integers(0, 3, 60),
        rng.permutation(60).astype(np.float32) / 60,
    )
    expected = non_maximum_suppression(boxes, 0.3, per_kind)
    assert non_maximum_suppression(boxes, 0.3, per_kind, hash_above=10).tolist() == expected.tolist()


def test_overlapping_outlines_leave_the_better_detection() -> None:
    """Boxes that overlap little, with outlines that cover each other: the worse one is rejected."""

    def answer(batch: np.ndarray) -> np.ndarray:
        output = np.zeros((len(batch), 9, 2), np.float32)
        output[:, :4, 0], output[:, :4, 1] = (50, 60, 8, 8), (57, 60, 8, 8)  # circles of radius 0.1 m, 0.07 m apart
        output[:, 4 + 2, 0], output[:, 4 + 2, 1] = 0.9, 0.8
        return output

    made = detector()
    made.yolo = Yolo(weights(ModelCard("yolo", "det"), answer))
    found = made.detect(grid_with((0.7, 1.3)))
    assert [detection.score for detection in found.found] == [pytest.approx(0.9)]
    (covered,) = found.rejected
    assert covered.reason == "its outline covers that of a better circle by more than 0.25 of the smaller one"
