"""From maps to primitives, with networks that give what a test wants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.detector import BATCH, Detector
from detect.networks.cnn import Estimator
from detect.networks.tiles import TILE
from detect.networks.weights import ALL_KINDS, Card, WeightsError
from detect.networks.yolo import Boxes, Yolo, suppress
from mapping.grid import GridFrame, OccupancyGrid
from prim.errors import UsageError
from prim.shapes import Kind
from tests.detect.fakes import blobs, constant, weights

CIRCLE_GREY = 0.8
"""What the blobs' YOLO takes for a circle."""


def detector(thresholds: dict[str, float] | None = None) -> Detector:
    yolo = weights(Card("yolo", "det", thresholds=thresholds or {}), blobs)
    # every kind: angle 0 (cosine 1, sine 0), offset (0.04, -0.02) m, sizes 0.2 and 0.1 m
    outputs = (
        [1, 0, 0.1, -0.05, 0.5]
        + [1, 0, 0.1, -0.05, 0.5, 0.25]
        + [0.1, -0.05, 0.25]
        + 2 * [1, 0, 0.1, -0.05, 0.5, 0.25]
    )
    return Detector(yolo, [constant("prim", ALL_KINDS, outputs)])


def grid_with(*centres: tuple[float, float], rows: int = 220, cols: int = 220, half: int = 10) -> OccupancyGrid:
    """A free map whose first cell lies at (0, 0), with solid blobs that stand for circles."""
    probability = np.full((rows, cols), 0.1, np.float32)
    for x, y in centres:
        row, col = round(y * 100), round(x * 100)
        probability[row - half : row + half, col - half : col + half] = CIRCLE_GREY
    return OccupancyGrid(GridFrame(0.01, 0, 0, rows, cols), probability)


def test_a_blob_becomes_a_primitive_where_it_lies() -> None:
    found = detector().detect(grid_with((0.7, 1.3)))
    (one,) = found.found
    assert one.primitive.kind is Kind.CIRCLE and one.score == pytest.approx(0.9)
    assert (one.primitive.x, one.primitive.y) == pytest.approx((0.7 + 0.04, 1.3 - 0.02), abs=0.006)
    assert one.primitive.size == pytest.approx((0.1,))
    assert one.crop.shape == (72, 72)


def test_what_scores_too_little_is_kept_for_the_rays() -> None:
    """The best of its place alone, measured, with its rejection; what was found leaves no doubt beside it."""
    found = detector({"circle": 0.95}).detect(grid_with((0.7, 1.3)))
    ((doubtful, rejection),) = found.doubtful
    assert doubtful.score == pytest.approx(0.9) and rejection in found.rejected
    assert (doubtful.primitive.x, doubtful.primitive.y) == pytest.approx((0.7 + 0.04, 1.3 - 0.02), abs=0.006)
    assert detector({"circle": 0.3}).detect(grid_with((0.7, 1.3))).doubtful == ()


def test_every_rejected_candidate_says_by_which_threshold() -> None:
    found = detector({"circle": 0.95}).detect(grid_with((0.7, 1.3)))
    assert not found.found
    low, lower = found.rejected
    assert low.reason == "score 0.90 is below 0.95, the least for a circle" and lower.score == pytest.approx(0.4)
    assert (low.x, low.y) == pytest.approx((0.7, 1.3), abs=0.006)
    (double,) = detector({"circle": 0.3}).detect(grid_with((0.7, 1.3))).rejected
    assert double.reason == "overlaps a better circle by more than 0.45 (IoU)"


def test_what_is_rejected_suppresses_nothing() -> None:
    """A circle below its threshold lies on an ellipse above its own: the ellipse is found."""

    def answer(batch: np.ndarray) -> np.ndarray:
        output = np.zeros((len(batch), 9, 2), np.float32)
        output[:, :4] = np.array([50, 60, 20, 20], np.float32)[None, :, None]
        output[:, 4 + 2, 0], output[:, 4 + 4, 1] = 0.55, 0.5
        return output

    made = detector()
    made.yolo = Yolo(weights(Card("yolo", "det"), answer))
    made.thresholds |= {Kind.CIRCLE: 0.6, Kind.ELLIPSE: 0.3}
    found = made.detect(grid_with((0.7, 1.3)))
    assert [one.primitive.kind for one in found.found] == [Kind.ELLIPSE]
    assert [one.reason[:10] for one in found.rejected] == ["score 0.55"]


def test_one_primitive_on_the_seam_of_tiles_is_found_once() -> None:
    """The map takes two tiles that share 64 cells: what lies there is seen by both."""
    rows, cols = TILE, 2 * TILE - 64
    for x in (1.7, 1.92, 1.62, 2.2):
        found = detector().detect(grid_with((x, 1.0), rows=rows, cols=cols))
        assert len(found.found) == 1
        assert found.found[0].primitive.x == pytest.approx(x + 0.04, abs=0.006)


def test_a_large_map_goes_through_in_batches() -> None:
    made = detector()
    centres = [(x, y) for x in np.arange(0.5, 11.5, 2.2) for y in np.arange(0.5, 8.5, 2.2)]
    session = made.yolo.weights.session
    session.batches.clear()  # type: ignore[attr-defined]
    made.detect(grid_with(*centres, rows=900, cols=1200))
    batches = session.batches  # type: ignore[attr-defined]
    assert len(batches) > 1 and max(batches) <= BATCH


@pytest.mark.parametrize("value", [0.5, 0.1])
def test_a_map_with_nothing_in_it(value: float) -> None:
    """All unknown, or all free: nothing is found, and no network runs."""
    made = detector()
    session = made.yolo.weights.session
    session.batches.clear()  # type: ignore[attr-defined]
    found = made.detect(OccupancyGrid(GridFrame(0.01, -50, 7, 300, 500), np.full((300, 500), value, np.float32)))
    assert found.found == () and found.rejected == () and session.batches == []  # type: ignore[attr-defined]


def test_another_resolution_is_refused() -> None:
    with pytest.raises(UsageError, match=r"cells of 0\.01 m, not 0\.02 m"):
        detector().detect(OccupancyGrid(GridFrame(0.02, 0, 0, 9, 9), np.ones((9, 9), np.float32)))


def test_networks_that_are_not_what_their_card_says() -> None:
    with pytest.raises(WeightsError, match="no detector"):
        Yolo(weights(Card("yolo", "det"), lambda batch: np.zeros((len(batch), 84, 10), np.float32)))
    with pytest.raises(WeightsError, match="3 numbers where its card says 5"):
        Estimator([constant("prim", ["square"], [1, 0, 0.5])])
    with pytest.raises(WeightsError, match="unknown preset"):
        Estimator([constant("magic", ["square"], [1, 0, 0.5])])


def test_suppression_by_hand() -> None:
    boxes = Boxes(
        np.array([(0, 0, 10, 10), (1, 0, 11, 10), (20, 0, 30, 10), (0, 1, 10, 11)], np.float32),
        np.array([0, 0, 0, 1]),
        np.array([0.5, 0.9, 0.3, 0.8], np.float32),
    )
    assert suppress(boxes, 0.5).tolist() == [1, 1, 2, 1]
    assert suppress(boxes, 0.5, per_kind=True).tolist() == [1, 1, 2, 3]
    assert suppress(boxes, 0.5, among=np.array([True, False, True, True])).tolist() == [3, -1, 2, 3]


@given(st.integers(0, 2**31), st.booleans())
def test_many_are_suppressed_as_few_are(seed: int, per_kind: bool) -> None:
    rng = np.random.default_rng(seed)
    corner, side = rng.uniform(-200, 200, (60, 2)), rng.uniform(5, 60, (60, 2))
    boxes = Boxes(
        np.concatenate((corner, corner + side), axis=1).astype(np.float32),
        rng.integers(0, 3, 60),
        rng.permutation(60).astype(np.float32) / 60,
    )
    few = suppress(boxes, 0.3, per_kind)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("detect.networks.yolo.MANY", 10)
        assert suppress(boxes, 0.3, per_kind).tolist() == few.tolist()


def test_two_primitives_are_not_in_one_place() -> None:
    """Boxes that overlap little, with outlines that cover each other: the better one stays, the other says why."""

    def answer(batch: np.ndarray) -> np.ndarray:
        output = np.zeros((len(batch), 9, 2), np.float32)
        output[:, :4, 0], output[:, :4, 1] = (50, 60, 8, 8), (57, 60, 8, 8)  # circles of radius 0.1 m, 0.07 m apart
        output[:, 4 + 2, 0], output[:, 4 + 2, 1] = 0.9, 0.8
        return output

    made = detector()
    made.yolo = Yolo(weights(Card("yolo", "det"), answer))
    found = made.detect(grid_with((0.7, 1.3)))
    assert [one.score for one in found.found] == [pytest.approx(0.9)]
    (covered,) = found.rejected
    assert covered.reason == "its outline covers that of a better circle by more than 0.25 of the smaller one"
