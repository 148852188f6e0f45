"""Tracking: persistent ids, confirmation and deletion, the filter, wrapped angles, the choice of the kind."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from detect.detection import Detection
from detect.tracker import DEFAULTS, Tracker, TrackerOptions
from prim.arrays import FloatArray
from prim.se2 import angle_difference
from prim.shapes import Kind, Primitive, angle_error

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
        (track,) = tracker.update(detections(primitive))
        distances.append(math.hypot(primitive.x - shape.x, primitive.y - shape.y))
        angles.append(angle_error(primitive, shape) or 0.0)
    estimate = track.primitive
    assert track.id == 1 and estimate.kind is shape.kind
    assert math.hypot(estimate.x - shape.x, estimate.y - shape.y) < np.mean(distances)
    assert (angle_error(estimate, shape) or 0.0) <= max(np.mean(angles), 1e-9)
    assert set(track.std) == {"x", "y", *(["theta"] if shape.theta is not None else []), *shape.sizes}
    assert 0 < track.std["x"] < DEFAULTS.position_std


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_the_filter_agrees_with_filterpys(shape: Primitive) -> None:
    """For varied scores and standard deviations, with angles unwrapped to the nearest of the state's."""
    rng, tracker = np.random.default_rng(5), Tracker()
    other = KalmanFilter(dim_x=len(vector(shape)), dim_z=len(vector(shape)))
    other.F = other.H = np.eye(other.dim_x)
    for update in range(12):
        primitive, score = perturbed(shape, rng), rng.uniform(0.01, 1)
        std = dict(zip(shape.kind.parameters, rng.uniform(0.001, 0.03, other.dim_x), strict=True))
        (track,) = tracker.update([Detection(primitive, score, (0, 0, 0, 0), CROP, std)])
        noise, values = np.diag(np.square(list(std.values())) + DEFAULTS.min_std**2), vector(primitive)
        if update == 0:
            other.x, other.P = values[:, None], noise
            continue
        if primitive.theta is not None:
            theta, period = other.x[2, 0], primitive.symmetry
            values[2] = theta + (0.0 if period is None else angle_difference(values[2], theta, period))
        other.predict(Q=noise * DEFAULTS.process_noise**2)
        other.update(values[:, None], R=noise / max(score, DEFAULTS.min_weight))
    expected = Primitive(shape.kind, *other.x[:2, 0], *split(shape, other.x[2:, 0])).canonical()
    assert vector(track.primitive) == pytest.approx(vector(expected), abs=1e-9)
    assert list(track.std.values()) == pytest.approx(np.sqrt(np.diag(other.P)), abs=1e-9)


def vector(shape: Primitive) -> FloatArray:
    return np.array([shape.x, shape.y, *([] if shape.theta is None else [shape.theta]), *shape.size])


def split(shape: Primitive, rest: FloatArray) -> tuple[float | None, tuple[float, ...]]:
    values = rest.tolist()
    return (None, tuple(values)) if shape.theta is None else (values[0], tuple(values[1:]))


def test_ids_persist_in_any_order_of_detections() -> None:
    rng, tracker = np.random.default_rng(0), Tracker()
    first = {shape.kind: track.id for shape, track in zip(SHAPES, tracker.update(detections(*SHAPES)), strict=True)}
    for _ in range(10):
        order = rng.permutation(len(SHAPES)).tolist()
        found = detections(*(perturbed(SHAPES[k], rng) for k in order))
        assert [track.id for track in tracker.update(found)] == [first[SHAPES[k].kind] for k in order]
    assert sorted(first.values()) == [1, 2, 3, 4, 5]


def test_confirmation_and_deletion() -> None:
    tracker = Tracker()
    (track,) = tracker.update(detections(SHAPES[0]))
    assert not track.confirmed
    tracker.update([])
    assert tracker.tracks == []  # a tentative track without a detection
    for _ in range(DEFAULTS.confirm_after):
        (track,) = tracker.update(detections(SHAPES[0]))
    assert track.confirmed and track.id == 2
    for _ in range(DEFAULTS.delete_after - 1):
        tracker.update([])
    assert tracker.update(detections(SHAPES[0]))[0].id == 2
    for _ in range(DEFAULTS.delete_after):
        tracker.update([])
    assert tracker.tracks == [] and tracker.update(detections(SHAPES[0]))[0].id == 3


def test_close_primitives_keep_their_ids() -> None:
    tracker, rng = Tracker(), np.random.default_rng(5)
    left, right = (Primitive(Kind.CIRCLE, x, 0, None, (0.06,)) for x in (-0.065, 0.065))
    ids = [track.id for track in tracker.update(detections(left, right))]
    for _ in range(20):
        assert [track.id for track in tracker.update(detections(perturbed(left, rng), perturbed(right, rng)))] == ids


def test_the_kind_has_the_largest_sum_of_scores() -> None:
    tracker = Tracker()
    square, rectangle = SHAPES[0], Primitive(Kind.RECTANGLE, -0.5, 0.5, 0.0, (0.21, 0.19))
    for primitive, score in ((square, 0.6), (rectangle, 0.9), (square, 0.6), (square, 0.6)):
        (track,) = tracker.update(detections(primitive, score=score))
    assert track.id == 1 and track.primitive.kind is Kind.SQUARE


def test_a_moving_primitive_keeps_its_track() -> None:
    tracker, shape = Tracker(), SHAPES[2]
    for k in range(30):
        (track,) = tracker.update(detections(replace(shape, x=0.01 * k)))
    assert track.id == 1 and track.primitive.x == pytest.approx(0.29, abs=0.05)


def test_options_set_confirmation_and_gate() -> None:
    tracker = Tracker(TrackerOptions(confirm_after=1, gate_share=0.0, min_gate=0.01))
    (track,) = tracker.update(detections(SHAPES[2]))
    assert track.confirmed
    (other,) = tracker.update(detections(replace(SHAPES[2], x=SHAPES[2].x + 0.02)))
    assert other.id == 2
