"""Tracks: ids that stay, rules of birth and death, angles that wrap, kinds that settle."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from detect.detection import Detection
from detect.tracker import CONFIRM, DRIFT, DROP, LEAST_STD, Tracker
from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive, angle_difference, angle_error

CROP = np.zeros((1, 1), np.uint8)
SHAPES = [
    Primitive(Kind.SQUARE, -0.5, 0.5, 0.01, (0.2,)),
    Primitive(Kind.RECTANGLE, 0.5, 0.5, math.pi - 0.02, (0.3, 0.15)),
    Primitive(Kind.CIRCLE, 0.5, -0.5, None, (0.2,)),
    Primitive(Kind.TRIANGLE, -0.5, -0.5, 2 * math.pi - 0.01, (0.2, 0.25)),
    Primitive(Kind.ELLIPSE, 0.0, 0.0, 0.02, (0.16, 0.08)),
]


def seen(*primitives: Primitive, score: float = 0.9) -> list[Detection]:
    return [Detection(one.canonical(), score, (0, 0, 0, 0), CROP) for one in primitives]


def shaken(shape: Primitive, rng: np.random.Generator) -> Primitive:
    theta = None if shape.theta is None else shape.theta + rng.normal(0, 0.1)
    x, y = shape.x + rng.normal(0, 0.01), shape.y + rng.normal(0, 0.01)
    return replace(shape, x=x, y=y, theta=theta, size=tuple(s + rng.normal(0, 0.01) for s in shape.size)).canonical()


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_a_track_is_better_than_its_sightings(shape: Primitive) -> None:
    """Angles near the wrap are averaged as angles; the mean of many looks is nearer to the truth than one look."""
    rng, tracker = np.random.default_rng(3), Tracker()
    places, angles = [], []
    for _ in range(40):
        one = shaken(shape, rng)
        (track,) = tracker.update(seen(one))
        places.append(math.hypot(one.x - shape.x, one.y - shape.y))
        angles.append(angle_error(one, shape) or 0.0)
    held = track.primitive
    assert track.id == 1 and held.kind is shape.kind
    assert math.hypot(held.x - shape.x, held.y - shape.y) < np.mean(places)
    assert (angle_error(held, shape) or 0.0) <= max(np.mean(angles), 1e-9)
    assert set(track.std) == {"x", "y", *(["theta"] if shape.theta is not None else []), *shape.sizes}
    assert 0 < track.std["x"] < 0.012


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind)
def test_the_filter_does_what_filterpys_does(shape: Primitive) -> None:
    """Over sightings of every score and sureness, angles taken on the turn that is nearest to the state's."""
    rng, tracker = np.random.default_rng(5), Tracker()
    other = KalmanFilter(dim_x=len(vector(shape)), dim_z=len(vector(shape)))
    other.F = other.H = np.eye(other.dim_x)
    for look in range(12):
        one, score = shaken(shape, rng), rng.uniform(0.01, 1)
        std = dict(zip(tracker_names(shape), rng.uniform(0.001, 0.03, other.dim_x), strict=True))
        (track,) = tracker.update([Detection(one, score, (0, 0, 0, 0), CROP, std)])
        noise, values = np.diag(np.square(list(std.values())) + LEAST_STD**2), vector(one)
        if look == 0:
            other.x, other.P = values[:, None], noise
            continue
        if one.theta is not None:
            held = other.x[2, 0]
            values[2] = held + (0.0 if one.symmetry is None else angle_difference(values[2], held, one.symmetry))
        other.predict(Q=noise * DRIFT**2)
        other.update(values[:, None], R=noise / max(score, 0.05))
    held = Primitive(shape.kind, *other.x[:2, 0], *split(shape, other.x[2:, 0])).canonical()
    assert vector(track.primitive) == pytest.approx(vector(held), abs=1e-9)
    assert list(track.std.values()) == pytest.approx(np.sqrt(np.diag(other.P)), abs=1e-9)


def vector(shape: Primitive) -> FloatArray:
    return np.array([shape.x, shape.y, *([] if shape.theta is None else [shape.theta]), *shape.size])


def split(shape: Primitive, rest: FloatArray) -> tuple[float | None, tuple[float, ...]]:
    values = rest.tolist()
    return (None, tuple(values)) if shape.theta is None else (values[0], tuple(values[1:]))


def tracker_names(shape: Primitive) -> list[str]:
    return ["x", "y", *([] if shape.theta is None else ["theta"]), *shape.sizes]


def test_ids_stay_whatever_the_order() -> None:
    rng, tracker = np.random.default_rng(0), Tracker()
    first = {shape.kind: track.id for shape, track in zip(SHAPES, tracker.update(seen(*SHAPES)), strict=True)}
    for _ in range(10):
        order = rng.permutation(len(SHAPES)).tolist()
        found = seen(*(shaken(SHAPES[k], rng) for k in order))
        assert [track.id for track in tracker.update(found)] == [first[SHAPES[k].kind] for k in order]
    assert sorted(first.values()) == [1, 2, 3, 4, 5]


def test_birth_and_death() -> None:
    tracker = Tracker()
    (track,) = tracker.update(seen(SHAPES[0]))
    assert not track.confirmed
    tracker.update([])
    assert tracker.tracks == []  # a tentative one that is missed goes
    for _ in range(CONFIRM):
        (track,) = tracker.update(seen(SHAPES[0]))
    assert track.confirmed and track.id == 2
    for _ in range(DROP - 1):
        tracker.update([])
    assert tracker.update(seen(SHAPES[0]))[0].id == 2
    for _ in range(DROP):
        tracker.update([])
    assert tracker.tracks == [] and tracker.update(seen(SHAPES[0]))[0].id == 3


def test_two_that_stand_close_keep_their_ids() -> None:
    tracker, rng = Tracker(), np.random.default_rng(5)
    left, right = (Primitive(Kind.CIRCLE, x, 0, None, (0.06,)) for x in (-0.065, 0.065))
    ids = [track.id for track in tracker.update(seen(left, right))]
    for _ in range(20):
        assert [track.id for track in tracker.update(seen(shaken(left, rng), shaken(right, rng)))] == ids


def test_the_kind_is_what_scores_most_in_all() -> None:
    tracker = Tracker()
    square, rectangle = SHAPES[0], Primitive(Kind.RECTANGLE, -0.5, 0.5, 0.0, (0.21, 0.19))
    for one, score in ((square, 0.6), (rectangle, 0.9), (square, 0.6), (square, 0.6)):
        (track,) = tracker.update(seen(one, score=score))
    assert track.id == 1 and track.primitive.kind is Kind.SQUARE


def test_what_moves_is_followed() -> None:
    tracker, shape = Tracker(), SHAPES[2]
    for k in range(30):
        (track,) = tracker.update(seen(replace(shape, x=0.01 * k)))
    assert track.id == 1 and track.primitive.x == pytest.approx(0.29, abs=0.05)
