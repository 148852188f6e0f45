import json
import math
from pathlib import Path

import numpy as np
import pytest

from prim.errors import WorldError
from prim.shapes import Kind, Primitive
from prim.world import Solid, World

BOX = np.array([(-0.6, -0.5), (-0.5, -0.5), (-0.5, 0.5), (-0.6, 0.5)])


def test_rays_into_the_corners_of_a_room_do_not_pass_between_the_walls() -> None:
    room = World((2.0, 2.0)).with_walls()
    for origin in ((0.0, 0.0), (0.3, -0.7)):
        corners = np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]) - origin
        lengths = np.linalg.norm(corners, axis=1)
        assert room.cast(origin, corners / lengths[:, None]) == pytest.approx(lengths)


def test_the_nearest_surface_is_met() -> None:
    world = World((2.0, 2.0), (Primitive(Kind.CIRCLE, 0.5, 0.0, None, (0.1,)),)).with_walls()
    distances = world.cast((0.0, 0.0), np.array([[1.0, 0.0], [-1.0, 0.0]]))
    assert distances == pytest.approx([0.4, 1.0])


def test_rays_in_an_empty_world_have_no_end() -> None:
    assert math.isinf(World((2.0, 2.0)).cast((0.0, 0.0), np.array([[1.0, 0.0]]))[0])


DART = Solid("dart", ((0.1, 0.15), (0.3, 0.1), (0.1, 0.5), (-0.1, 0.1)))


def test_clutter_and_structure_are_met_by_rays() -> None:
    room = World((2.0, 2.0), clutter=(DART,), structure=(Solid.of("wall", BOX),)).with_walls()
    directions = np.array([[0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]])
    assert room.cast((0.1, 0.0), directions) == pytest.approx([0.15, 0.6, 0.9])
    assert room.solids == room.clutter + room.structure


def test_clutter_round_trips_and_old_files_have_none(tmp_path: Path) -> None:
    world = World((2.0, 2.0), clutter=(DART,), structure=(Solid.of("wall", BOX),))
    value = json.loads(json.dumps(world.to_json()))
    assert World.from_json(value) == world
    assert value["clutter"] == [{"name": "dart", "outline": [[0.1, 0.15], [0.3, 0.1], [0.1, 0.5], [-0.1, 0.1]]}]
    turned = value | {"clutter": [{"name": "dart", "outline": value["clutter"][0]["outline"][::-1]}]}
    assert set(World.from_json(turned).clutter[0].outline) == set(DART.outline)
    assert World.from_json({"size": [2, 2]}) == World((2.0, 2.0))
    assert {"clutter", "structure"}.isdisjoint(World((2.0, 2.0)).to_json())


SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]


@pytest.mark.parametrize("key", ["clutter", "structure"])
@pytest.mark.parametrize(
    ("items", "said"),
    [
        (3, "is a list, not 3"),
        ([3], "is no object with 'name'"),
        ([{"outline": SQUARE}], "is no object with 'name'"),
        ([{"name": 3, "outline": SQUARE}], "a name has 1 to 100 characters"),
        ([{"name": "", "outline": SQUARE}], "a name has 1 to 100 characters"),
        ([{"name": "a" * 101, "outline": SQUARE}], "a name has 1 to 100 characters"),
        ([{"name": "a"}], "no simple polygon"),
        ([{"name": "a", "outline": 4}], "outline is a list, not 4"),
        ([{"name": "a", "outline": SQUARE[:2]}], "no simple polygon"),
        ([{"name": "a", "outline": [SQUARE[0]] * 3}], "no simple polygon"),
        ([{"name": "a", "outline": [SQUARE[k] for k in (0, 2, 1, 3)]}], "no simple polygon"),
        ([{"name": "a", "outline": [*SQUARE, [1]]}], "a vertex is 2 numbers"),
        ([{"name": "a", "outline": [*SQUARE, [1, 1e12]]}], "reaches farther"),
        ([{"name": "a", "outline": [*SQUARE, [1, None]]}], "a vertex is 2 numbers"),
    ],
)
def test_things_that_cannot_be_are_refused(key: str, items: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        World.from_json({"size": [2, 2], key: items})


def test_things_are_bounded() -> None:
    turn = np.linspace(0, 2 * math.pi, 9_000, endpoint=False)
    outline = np.column_stack((np.cos(turn), np.sin(turn))).tolist()
    disc = {"name": "disc", "outline": outline}
    World.from_json({"size": [2, 2], "clutter": [disc] * 3, "structure": [disc]})
    with pytest.raises(ValueError, match="108,000 vertices, more than 100,000"):
        World.from_json({"size": [2, 2], "clutter": [disc] * 6, "structure": [disc] * 6})
    with pytest.raises(ValueError, match="more than 10,000"):
        World.from_json({"size": [2, 2], "clutter": [disc] * 10_001})


def test_an_outline_runs_counter_clockwise() -> None:
    with pytest.raises(ValueError, match="counter-clockwise"):
        Solid("dart", DART.outline[::-1])


def test_file_round_trip(tmp_path: Path) -> None:
    world = World((2.0, 3.0), (Primitive(Kind.ELLIPSE, 0.5, 0.0, 1.0, (0.2, 0.1)),)).with_walls()
    path = tmp_path / "world.json"
    path.write_text(json.dumps(world.to_json()))
    assert World.load(path) == world


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"size": 2}', '{"size": [2, 2], "walls": [[1, 2]]}', '{"size": [2, 2], "primitives": 3}'],
)
def test_a_file_that_is_no_world_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "world.json"
    path.write_text(text)
    with pytest.raises(WorldError, match=r"world\.json: not a world"):
        World.load(path)
