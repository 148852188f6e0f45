import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from prim.shapes import Kind, Primitive, angle_error

LENGTHS = st.floats(0.02, 0.5)
ANGLES = st.floats(-10, 10)


@st.composite
def primitives(draw: st.DrawFn, kinds: tuple[Kind, ...] = tuple(Kind)) -> Primitive:
    kind = draw(st.sampled_from(kinds))
    theta = None if kind is Kind.CIRCLE else draw(ANGLES)
    size = tuple(draw(LENGTHS) for _ in kind.sizes)
    return Primitive(kind, draw(st.floats(-1, 1)), draw(st.floats(-1, 1)), theta, size)


@given(primitives())
def test_outline_has_the_centroid_and_area_of_the_shape(primitive: Primitive) -> None:
    polygon = shapely.Polygon(primitive.outline())
    assert polygon.centroid.coords[0] == pytest.approx((primitive.x, primitive.y), abs=1e-9)
    assert polygon.area == pytest.approx(primitive.area, rel=1e-3)
    assert shapely.LinearRing(primitive.outline()).is_ccw


@given(primitives())
def test_canonical_form_is_the_same_shape_in_range(primitive: Primitive) -> None:
    canonical = primitive.canonical()
    assert canonical.canonical() == canonical
    outlines = (shapely.Polygon(shape.outline()) for shape in (primitive, canonical))
    assert shapely.symmetric_difference(*outlines, grid_size=1e-9).area < 1e-6  # of edges that are nearly the same
    if canonical.kind in (Kind.RECTANGLE, Kind.ELLIPSE):
        assert canonical.size[0] >= canonical.size[1]
    if canonical.theta is not None:
        top = {Kind.SQUARE: math.pi / 2, Kind.TRIANGLE: 2 * math.pi}.get(canonical.kind, math.pi)
        assert 0 <= canonical.theta < top


@given(primitives(), st.floats(0, 2 * math.pi))
def test_cast_ends_on_the_outline(primitive: Primitive, bearing: float) -> None:
    """A ray towards the centroid from outside ends where the polygon's boundary is first met."""
    origin = (primitive.x + 2 * math.cos(bearing), primitive.y + 2 * math.sin(bearing))
    direction = np.array([[-math.cos(bearing), -math.sin(bearing)]])
    (distance,) = primitive.cast(origin, direction)
    outline = shapely.Polygon(primitive.outline(2000))
    expected = outline.distance(shapely.Point(origin))
    end = shapely.Point(np.array(origin) + distance * direction[0])
    assert outline.exterior.distance(end) < 1e-5
    assert expected - 1e-5 <= distance < 2


@given(primitives(), st.integers(0, 1000))
def test_cast_agrees_with_polygon_intersection(primitive: Primitive, seed: int) -> None:
    rng = np.random.default_rng(seed)
    bearings = rng.uniform(0, 2 * math.pi, 40)
    directions = np.column_stack((np.cos(bearings), np.sin(bearings)))
    origin = (primitive.x + rng.uniform(-1, 1), primitive.y + rng.uniform(-1, 1))
    distances = primitive.cast(origin, directions)
    boundary = shapely.Polygon(primitive.outline(2000)).exterior
    for direction, distance in zip(directions, distances, strict=True):
        ray = shapely.LineString([origin, np.array(origin) + 5 * direction])
        met = boundary.intersection(ray)
        if math.isinf(distance):
            assert met.is_empty or met.length < 0.02 or shapely.get_num_coordinates(met) == 1
        elif not met.is_empty:
            assert distance == pytest.approx(met.distance(shapely.Point(origin)), abs=2e-3)


def test_cast_from_inside_reaches_the_outline() -> None:
    square = Primitive(Kind.SQUARE, 1.0, 2.0, 0.0, (0.4,))
    assert square.cast((1.0, 2.0), np.array([[1.0, 0.0], [0.0, -1.0]])) == pytest.approx([0.2, 0.2])
    circle = Primitive(Kind.CIRCLE, 1.0, 2.0, None, (0.4,))
    assert circle.cast((1.1, 2.0), np.array([[1.0, 0.0], [-1.0, 0.0]])) == pytest.approx([0.3, 0.5])


def test_cast_along_an_edge_and_away() -> None:
    square = Primitive(Kind.SQUARE, 0.0, 0.0, 0.0, (2.0,))
    away = square.cast((-3.0, 0.0), np.array([[-1.0, 0.0], [0.0, 1.0]]))
    assert np.isinf(away).all()
    assert square.cast((-3.0, 1.0 + 1e-9), np.array([[1.0, 0.0]]))[0] == math.inf


@pytest.mark.parametrize(
    ("kind", "size", "symmetry"),
    [
        (Kind.SQUARE, (0.2,), math.pi / 2),
        (Kind.RECTANGLE, (0.2, 0.1), math.pi),
        (Kind.RECTANGLE, (0.2, 0.195), math.pi / 2),
        (Kind.CIRCLE, (0.2,), None),
        (Kind.TRIANGLE, (0.2, 0.3), 2 * math.pi),
        (Kind.TRIANGLE, (0.2, 0.2 * math.sqrt(3) / 2), 2 * math.pi / 3),
        (Kind.ELLIPSE, (0.2, 0.1), math.pi),
        (Kind.ELLIPSE, (0.2, 0.195), None),
    ],
)
def test_symmetry(kind: Kind, size: tuple[float, ...], symmetry: float | None) -> None:
    theta = None if kind is Kind.CIRCLE else 0.1
    assert Primitive(kind, 0, 0, theta, size).symmetry == pytest.approx(symmetry)


def test_the_papers_example_of_a_square_turned_by_a_right_angle() -> None:
    """III-C: 95 degrees predicted for a square labelled 5 degrees is no error."""
    truth = Primitive(Kind.SQUARE, 0, 0, math.radians(5), (0.2,))
    estimate = Primitive(Kind.SQUARE, 0, 0, math.radians(95), (0.2,))
    assert angle_error(estimate, truth) == pytest.approx(0, abs=1e-12)


def test_the_bounding_radius_is_about_the_centroid() -> None:
    """A right isosceles triangle: the circumscribed circle has another centre and is smaller."""
    triangle = Primitive(Kind.TRIANGLE, 0, 0, 0.3, (0.2, 0.1))
    assert triangle.bounding_radius == pytest.approx(math.hypot(0.1, 0.1 / 3))
    assert triangle.bounding_radius > 0.1 + 1e-3  # half the hypotenuse: the circumscribed circle


def test_width_and_height_are_the_papers() -> None:
    assert Primitive(Kind.CIRCLE, 0, 0, None, (0.1,)).width_height == (0.1, 0.1)
    assert Primitive(Kind.SQUARE, 0, 0, 0.0, (0.1,)).width_height == (0.1, 0.1)
    assert Primitive(Kind.TRIANGLE, 0, 0, 0.0, (0.1, 0.2)).width_height == (0.1, 0.2)


@given(primitives())
def test_json_round_trip(primitive: Primitive) -> None:
    assert Primitive.from_json(primitive.to_json()) == primitive


@pytest.mark.parametrize(
    ("value", "named"),
    [
        ({"kind": "pentagon"}, "pentagon"),
        ({"kind": "circle", "x": 0, "y": 0, "size": {"side": 1}}, "side"),
        ({"kind": "circle", "x": 0, "y": 0, "size": {"radius": -1}}, "positive"),
        ({"kind": "square", "x": 0, "y": 0, "size": {"side": 1}}, "theta"),
        ({"kind": "square", "x": 0, "y": None, "theta": 0, "size": {"side": 1}}, "describe"),
        ({"kind": "circle", "x": math.nan, "y": 0, "size": {"radius": 1}}, "finite"),
    ],
)
def test_wrong_json_is_named(value: dict[str, object], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        Primitive.from_json(value)
