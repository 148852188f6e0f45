"""Tracking: persistent ids, confirmation and deletion, the filter, wrapped angles, the choice of the kind."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detect.detection import Detection
from detect.tracker import DEFAULTS, Tracker, TrackerOptions
from prim.arrays import FloatArray
from prim.se2 import angle_difference
from prim.shapes import Kind, Primitive, angle_error

ROOT = Path(__file__).parents[2]
SECOND = 10**9
CROP = np.zeros((1, 1), np.uint8)
SHAPES = [
    Primitive(Kind.SQUARE, -0.5, 0.5, 0.01, (0.2,)),
    Primitive(Kind.RECTANGLE, 0.5, 0.5, math.pi - 0.02, (0.3, 0.15)),
    Primitive(Kind.CIRCLE, 0.5, -0.5, None, (0.2,)),
    Primitive(Kind.TRIANGLE, -0.5, -0.5, 2 * math.pi - 0.01, (0.2, 0.25)),
    Primitive(Kind.ELLIPSE, 0.0, 0.0, 0.02, (0.16, 0.08)),
]


def detections(*primitives: Primitive, score: float = 0.9) -> list[Detection]:
    return [Detection(primitive.canonical(), score, (0, 0, 0, 0), CROP) for primitive in primitives]


def perturbed(shape: Primitive, rng: np.random.Generator) -> Primitive:
    theta = None if shape.theta is None else shape.theta + rng.normal(0, 0.1)
    x, y = shape.x + rng.normal(0, 0.01), shape.y + rng.normal(0, 0.01)
    return replace(shape, x=x, y=y, theta=theta, size=tuple(s + rng.normal(0, 0.01) for s in shape.size)).canonical()


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_a_track_is_more_accurate_than_its_detections(shape: Primitive) -> None:
    """Also where the angle wraps around: the estimate is nearer to the truth than the mean detection."""
    rng, tracker = np.random.default_rng(3), Tracker()
    distances, angles = [], []
    for _ in range(40):
        primitive = perturbed(shape, rng)
        (track,) = tracker.update(detections(primitive), 0)
        distances.append(math.hypot(primitive.x - shape.x, primitive.y - shape.y))
        angles.append(angle_error(primitive, shape) or 0.0)
    estimate = track.primitive
    assert track.id == 1 and estimate.kind is shape.kind
    assert math.hypot(estimate.x - shape.x, estimate.y - shape.y) < np.mean(distances)
    assert (angle_error(estimate, shape) or 0.0) <= max(np.mean(angles), 1e-9)
    assert set(track.std) == {"x", "y", *(["theta"] if shape.theta is not None else []), *shape.sizes}
    assert 0 < track.std["x"] < DEFAULTS.position_std


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_the_estimate_of_what_stands_is_the_information_weighted_mean(shape: Primitive) -> None:
    """In closed form, with full covariances: without process noise, of detections with the score 1."""
    rng, tracker = np.random.default_rng(5), Tracker(TrackerOptions(process_noise=0.0, max_innovation=math.inf))
    size = len(shape.kind.parameters)
    information, weighted = np.zeros((size, size)), np.zeros(size)
    for update in range(12):
        root = rng.normal(0, 0.01, (size, size))
        covariance = root @ root.T + 1e-6 * np.eye(size)
        primitive = moderately_perturbed(shape, rng)
        (track,) = tracker.update([detection_with(primitive, covariance)], update * SECOND)
        inverse = np.linalg.inv(covariance + DEFAULTS.min_std**2 * np.eye(size))
        values = vector(primitive)
        if shape.theta is not None:
            values[2] = shape.theta + angle_difference(values[2], shape.theta, shape.symmetry or 2 * math.pi)
        information, weighted = information + inverse, weighted + inverse @ values
    mean = np.linalg.solve(information, weighted)
    expected = Primitive(shape.kind, *mean[:2], *split(shape, mean[2:])).canonical()
    assert vector(track.primitive) == pytest.approx(vector(expected), abs=1e-9)
    assert list(track.std.values()) == pytest.approx(np.sqrt(np.diag(np.linalg.inv(information))), rel=1e-9)


def test_what_stands_tends_to_the_steady_state_variance() -> None:
    """Of one parameter p: p = (p + q) r / (p + q + r), so that p² + q p - q r = 0, with q the process noise."""
    tracker, covariance = Tracker(), np.diag([4e-6, 9e-6, 1e-6])
    for update in range(60):
        (track,) = tracker.update([detection_with(SHAPES[2], covariance)], update * SECOND)
    r = np.diag(covariance) + DEFAULTS.min_std**2
    q = DEFAULTS.process_noise**2 * r
    assert np.square(list(track.std.values())) == pytest.approx((np.sqrt(q**2 + 4 * q * r) - q) / 2, rel=1e-9)


@pytest.mark.parametrize("seconds", [0.5, 6.0])
def test_what_moves_follows_at_once_and_at_constant_velocity(seconds: float) -> None:
    """From its second place on the estimate is the detection's; its next place is predicted."""
    tracker, shape, covariance = Tracker(), SHAPES[0], np.diag([1e-6] * 4)
    step = 0.19 if seconds > 1 else 0.09
    for update in range(3):
        tracker.update([detection_with(shape, covariance)], round(update * seconds * SECOND))
    for update in range(3, 8):
        shape = replace(shape, x=shape.x + step)
        (track,) = tracker.update([detection_with(shape, covariance)], round(update * seconds * SECOND))
        assert (track.id, track.best.moving) == (1, True)
        assert track.primitive.x == pytest.approx(shape.x, abs=3e-3)
    ahead = track.best.predicted(round(8 * seconds * SECOND))
    assert ahead.x == pytest.approx(shape.x + step, abs=0.1 * step) and ahead.y == pytest.approx(shape.y, abs=1e-3)


def test_what_was_moved_stands_again_and_gains_by_every_detection() -> None:
    tracker, covariance = Tracker(), np.diag([1e-6] * 3)
    places = [0.5, 0.5, 0.5, 0.6, 0.7, 0.7, 0.7, 0.7, 0.7]
    moving, stds = [], []
    for update, x in enumerate(places):
        (track,) = tracker.update([detection_with(replace(SHAPES[2], x=x), covariance)], update * SECOND)
        moving.append(track.best.moving)
        stds.append(track.std["x"])
        assert track.primitive.x == pytest.approx(x, abs=1e-3)
    assert moving == [False] * 3 + [True] * 2 + [False] * 4
    assert stds[3] == pytest.approx(math.sqrt(2e-6)) and stds[-1] < 0.7 * stds[3]


def test_more_work_on_the_same_scans_is_no_motion() -> None:
    tracker, covariance = Tracker(), np.diag([1e-6] * 3)
    for x in (0.5, 0.6):
        (track,) = tracker.update([detection_with(replace(SHAPES[2], x=x), covariance)], SECOND)
    assert not track.best.moving and track.primitive.x == pytest.approx(0.6)


def test_what_was_pushed_far_keeps_its_id_and_a_neighbour_its_own() -> None:
    """A square is pushed past a circle: no further than the robot pushes, and it is taken for nothing else."""
    tracker, circle = Tracker(), Primitive(Kind.CIRCLE, 0.0, 0.15, None, (0.07,))
    square = Primitive(Kind.SQUARE, -0.4, 0.0, 0.0, (0.15,))
    for update in range(2):
        before = tracker.update(detections(square, circle), update * 6 * SECOND)
    ids = [track.id for track in before]
    pushed = replace(square, x=0.4)
    assert [track.id for track in tracker.update(detections(circle, pushed), 12 * SECOND)] == ids[::-1]
    too_soon = replace(square, x=-0.4)
    assert tracker.update(detections(too_soon), 13 * SECOND)[0].id not in ids
    other = Primitive(Kind.SQUARE, 0.9, 0.0, 0.0, (0.25,))
    assert tracker.update(detections(other), 30 * SECOND)[0].id not in ids


def test_a_detection_of_another_kind_moves_the_track() -> None:
    """The estimate of the best kind follows what was detected as another."""
    tracker, square = Tracker(), SHAPES[0]
    for update in range(4):
        tracker.update(detections(square), update * SECOND)
    rectangle = Primitive(Kind.RECTANGLE, square.x + 0.08, square.y, 0.0, (0.21, 0.19))
    (track,) = tracker.update(detections(rectangle), 4 * SECOND)
    assert track.primitive.kind is Kind.SQUARE and track.primitive.x == pytest.approx(rectangle.x, abs=0.01)


def detection_with(primitive: Primitive, covariance: FloatArray) -> Detection:
    std = dict(zip(primitive.kind.parameters, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    return Detection(primitive.canonical(), 1.0, (0, 0, 0, 0), CROP, std, covariance=covariance)


def moderately_perturbed(shape: Primitive, rng: np.random.Generator) -> Primitive:
    theta = None if shape.theta is None else shape.theta + rng.normal(0, 0.01)
    return replace(shape, x=shape.x + rng.normal(0, 0.002), theta=theta).canonical()


def vector(shape: Primitive) -> FloatArray:
    return np.array([shape.x, shape.y, *([] if shape.theta is None else [shape.theta]), *shape.size])


def split(shape: Primitive, rest: FloatArray) -> tuple[float | None, tuple[float, ...]]:
    values = rest.tolist()
    return (None, tuple(values)) if shape.theta is None else (values[0], tuple(values[1:]))


def test_ids_persist_in_any_order_of_detections() -> None:
    rng, tracker = np.random.default_rng(0), Tracker()
    first = {
        shape.kind: track.id for shape, track in zip(SHAPES, tracker.update(detections(*SHAPES), 0), strict=True)
    }
    for _ in range(10):
        order = rng.permutation(len(SHAPES)).tolist()
        found = detections(*(perturbed(SHAPES[k], rng) for k in order))
        assert [track.id for track in tracker.update(found, 0)] == [first[SHAPES[k].kind] for k in order]
    assert sorted(first.values()) == [1, 2, 3, 4, 5]


def test_confirmation_and_deletion() -> None:
    tracker = Tracker()
    (track,) = tracker.update(detections(SHAPES[0]), 0)
    assert not track.confirmed
    tracker.update([], 0)
    assert tracker.tracks == []  # a tentative track without a detection
    for _ in range(DEFAULTS.confirm_after):
        (track,) = tracker.update(detections(SHAPES[0]), 0)
    assert track.confirmed and track.id == 2
    for _ in range(DEFAULTS.delete_after - 1):
        tracker.update([], 0)
    assert tracker.update(detections(SHAPES[0]), 0)[0].id == 2
    for _ in range(DEFAULTS.delete_after):
        tracker.update([], 0)
    assert tracker.tracks == [] and tracker.last_id == 2
    assert tracker.update(detections(SHAPES[0]), 0)[0].id == tracker.last_id == 3


def test_close_primitives_keep_their_ids() -> None:
    tracker, rng = Tracker(), np.random.default_rng(5)
    left, right = (Primitive(Kind.CIRCLE, x, 0, None, (0.06,)) for x in (-0.065, 0.065))
    ids = [track.id for track in tracker.update(detections(left, right), 0)]
    for _ in range(20):
        assert [
            track.id for track in tracker.update(detections(perturbed(left, rng), perturbed(right, rng)), 0)
        ] == ids


def test_the_kind_has_the_largest_sum_of_scores() -> None:
    tracker = Tracker()
    square, rectangle = SHAPES[0], Primitive(Kind.RECTANGLE, -0.5, 0.5, 0.0, (0.21, 0.19))
    for primitive, score in ((square, 0.6), (rectangle, 0.9), (square, 0.6), (square, 0.6)):
        (track,) = tracker.update(detections(primitive, score=score), 0)
    assert track.id == 1 and track.primitive.kind is Kind.SQUARE


def test_a_moving_primitive_keeps_its_track() -> None:
    tracker, shape = Tracker(), SHAPES[2]
    for k in range(30):
        (track,) = tracker.update(detections(replace(shape, x=0.01 * k)), 0)
    assert track.id == 1 and track.primitive.x == pytest.approx(0.29, abs=0.05)


def test_options_set_confirmation_and_gate() -> None:
    tracker = Tracker(TrackerOptions(confirm_after=1, gate_share=0.0, min_gate=0.01))
    (track,) = tracker.update(detections(SHAPES[2]), 0)
    assert track.confirmed
    (other,) = tracker.update(detections(replace(SHAPES[2], x=SHAPES[2].x + 0.02)), 0)
    assert other.id == 2


def tracked(*steps: list[Detection]) -> list[list[int]]:
    """Ids at each of some updates, four seconds apart."""
    tracker = Tracker()
    return [[track.id for track in tracker.update(step, k * 4 * SECOND)] for k, step in enumerate(steps)]


def test_what_is_alike_comes_before_what_is_near() -> None:
    """In the narrow gates of both a detection belongs to the track of its own kind, though the other's is nearer."""
    square, circle = Primitive(Kind.SQUARE, 0.0, 0.0, 0.1, (0.2,)), Primitive(Kind.CIRCLE, 0.09, 0.0, None, (0.1,))
    before = detections(square, circle)
    assert tracked(before, before, detections(replace(circle, x=0.04))) == [[1, 2], [1, 2], [2]]


def test_confirmed_tracks_come_before_tentative_ones() -> None:
    circle = Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,))
    near = replace(circle, x=0.07)
    ids = tracked(
        detections(circle), detections(circle), detections(circle, near), detections(replace(circle, x=0.05))
    )
    assert ids == [[1], [1], [1, 2], [1]]


def test_what_is_known_to_have_moved_is_associated_over_its_reach_and_last() -> None:
    """Also as another kind; but what is alike goes first, and what is not known to have moved is something new."""
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.1, (0.2,))
    far = replace(square, x=0.5)
    other = Primitive(Kind.CIRCLE, 0.5, 0.0, None, (0.1,))
    before = detections(square)

    def moved(*primitives: Primitive) -> list[Detection]:
        return [replace(detection, since=7) for detection in detections(*primitives)]

    assert tracked(before, before, moved(other))[-1] == [1]
    assert tracked(before, before, detections(other))[-1] == [2]
    assert tracked(before, before, moved(replace(other, x=0.4), far))[-1] == [2, 1]
    assert tracked(before, before, moved(replace(other, x=0.9)))[-1] == [2]


def test_what_is_known_to_have_moved_comes_before_what_is_near_and_unlike() -> None:
    """A pushed square and a circle that comes to stand where it was: the square keeps its id."""
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.1, (0.2,))
    arrived = Primitive(Kind.CIRCLE, 0.03, 0.0, None, (0.1,))
    before = detections(square)
    pushed = [replace(detection, since=7) for detection in detections(replace(square, x=0.5))]
    assert tracked(before, before, [*detections(arrived), *pushed])[-1] == [2, 1]


def test_a_displacement_within_the_least_one_is_no_motion() -> None:
    """However sure both places are: poses and grids have errors of millimetres."""
    covariance = 1e-10 * np.eye(3)
    tracker, circle = Tracker(TrackerOptions(min_std=1e-5)), Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,))
    for k in range(4):
        (track,) = tracker.update([detection_with(replace(circle, x=0.004 * (k % 2)), covariance)], k * SECOND)
    assert not track.best.moving
    (track,) = tracker.update([detection_with(replace(circle, x=0.02), covariance)], 4 * SECOND)
    assert track.best.moving


def test_the_likelihood_of_filterpy_is_loaded_when_it_is_asked_for() -> None:
    """The module that stands in for its statistics gives the real one's values, and is gone after the import."""
    code = "\n".join(
        [
            "import sys, numpy as np; from detect.kalman import KalmanFilter",
            "assert not {'scipy.stats', 'scipy.ndimage'} & {*sys.modules}",
            "f = KalmanFilter(dim_x=1, dim_z=1); f.H = np.eye(1); f.predict(); f.update(np.array([[0.5]]))",
            "print(f.log_likelihood)",
            "from filterpy.stats import logpdf; print(logpdf(f.y, cov=f.S))",
            "import filterpy; assert filterpy.discrete_bayes.normalize and filterpy.stats.gaussian",
            "from filterpy.discrete_bayes import normalize",
        ]
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    asked, real = map(float, run.stdout.split())
    assert asked == pytest.approx(real) and math.isfinite(asked)
