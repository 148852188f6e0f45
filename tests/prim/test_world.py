import json
import math
from pathlib import Path

import numpy as np
import pytest

from prim.errors import WorldError
from prim.shapes import Kind, Primitive
from prim.world import World


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
