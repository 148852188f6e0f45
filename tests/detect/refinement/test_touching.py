"""Things that touch: two shapes with one guess are found as two; what is made as one thing is not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.geometry.polygon import orient

from detect.detection import Detection, Detections
from detect.refinement.options import DEFAULTS
from detect.refinement.outlines.cuts import partitions
from detect.refinement.outlines.flush import are_flush, is_one_piece
from detect.refinement.refine import refine_detections
from detect.refinement.surroundings.map_cells import MapCells
from detect.refinement.touching import find_sites
from prim.arrays import FloatArray
from prim.metrics import polygon_iou
from prim.shapes import Kind, Primitive
from prim.world import World
from tests.detect.refinement.rooms import WALLS, mapped, scans

SQUARE = Primitive(Kind.SQUARE, -0.1, 0.0, 0.0, (0.2,))
DISC = Primitive(Kind.CIRCLE, 0.08, 0.03, None, (0.08,))
GUESS = Primitive(Kind.RECTANGLE, -0.02, 0.0, 0.0, (0.34, 0.2))
L_SHAPE = np.array([(0.04, 0.04), (0.24, 0.04), (0.24, 0.12), (0.11, 0.12), (0.11, 0.24), (0.04, 0.24)])
"""Between places of 7 x 7 scans."""
TOUCHING = (SQUARE, DISC)


def union_of(*primitives: Primitive) -> FloatArray:
    """The outline (V, 2) of primitives that touch, counter-clockwise."""
    together = shapely.union_all([shapely.Polygon(one.outline(48)).buffer(1e-4) for one in primitives])
    return np.asarray(orient(together.simplify(1e-3)).exterior.coords)[:-1]


def refined(world: World, stops: int = 8, at: float = 0.0, closed: bool = False) -> Detections:
    """What refinement makes of one guess."""
    taken = scans(world, 0.02, stops=stops)
    guess = Detection(replace(GUESS, x=GUESS.x + at, y=at), 0.9, (0.0, 0.0, 0.0, 0.0), np.zeros((0, 0), np.uint8))
    options = replace(DEFAULTS, closed_world=closed)
    return refine_detections(Detections((guess,), ()), taken, mapped(taken), threads=1, options=options)[0]


def test_two_touching_shapes_with_one_guess_are_found_as_two() -> None:
    world = World((2.0, 2.0), TOUCHING, WALLS)
    found = refined(world).found
    assert {detection.primitive.kind for detection in found} == {true.kind for true in TOUCHING}
    assert len(found) == 2
    for true in TOUCHING:
        assert max(polygon_iou(detection.primitive, true) for detection in found) > 0.95
    assert all(detection.score > 0.9 for detection in found)


def test_in_a_closed_world_one_guess_stays_one() -> None:
    world = World((2.0, 2.0), TOUCHING, WALLS)
    assert len(refined(world, closed=True).found) <= 1


def test_an_l_is_not_two_confident_rectangles() -> None:
    sides = zip(L_SHAPE.tolist(), np.roll(L_SHAPE, -1, axis=0).tolist(), strict=True)
    world = World((2.0, 2.0), (), (*WALLS, *((*first, *last) for first, last in sides)))
    result = refined(world, stops=7, at=0.14)
    assert not [detection for detection in result.found if detection.score > 0.5]
    assert len(result.objects) == 1


def test_the_best_cut_is_where_two_shapes_touch() -> None:
    best = partitions(union_of(*TOUCHING))[0]
    assert best.mismatch < 0.05
    for true in TOUCHING:
        assert max(polygon_iou(guess, true) for guess in best.guesses) > 0.9


def test_convex_outlines_and_such_as_cross_themselves_are_not_cut() -> None:
    bow = np.array([(0.0, 0.0), (0.2, 0.2), (0.2, 0.0), (0.0, 0.2)])
    assert partitions(SQUARE.outline()) == [] == partitions(bow)


@pytest.mark.parametrize(
    ("x", "y", "turn", "flush", "piece"),
    [
        (0.15, 0.03, 0.0, True, False),
        (0.15, 0.05, 0.0, True, True),  # the upper sides in one line
        (0.15, 0.00, 0.0, True, True),  # on one axis
        (0.15, 0.03, math.pi / 2, True, False),
        (0.17, 0.03, 0.2, False, False),
        (0.19, 0.03, 0.0, False, False),  # apart
    ],
)
def test_parallel_sides_that_touch_are_flush(x: float, y: float, turn: float, flush: bool, piece: bool) -> None:
    large = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (0.2,))
    small = Primitive(Kind.SQUARE, x, y, turn, (0.1,)).canonical()
    assert are_flush(large, small) == are_flush(small, large) == flush
    assert is_one_piece([large, small]) == is_one_piece([small, large]) == piece


def test_round_shapes_are_never_flush() -> None:
    assert not are_flush(SQUARE, DISC)
    assert not is_one_piece(TOUCHING)


def test_a_site_holds_the_guesses_of_one_component_and_is_covered_where_rays_suffice() -> None:
    other = Primitive(Kind.SQUARE, -0.5, -0.5, 0.3, (0.2,))
    cells = MapCells.of(mapped(scans(World((2.0, 2.0), (*TOUCHING, other), WALLS), 0.0)))
    found = {tuple(site.members): site for site in find_sites(cells, [*TOUCHING, other])}
    assert found.keys() == {(0, 1), (2,)}
    assert found[(2,)].covered_by == 2
    assert found[(0, 1)].covered_by is None
    assert math.hypot(found[(0, 1)].circle.x + 0.02, found[(0, 1)].circle.y) < 0.03
