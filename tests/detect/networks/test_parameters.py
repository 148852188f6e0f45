"""Crops and outputs: what a network sees, what its numbers mean, and that turning both agrees."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st

from detect.networks.parameters import (
    LONGEST,
    PAPER,
    PRIM,
    Preset,
    crop,
    read_outputs,
    read_triangle,
    targets,
    triangle_outputs,
)
from detect.networks.tiles import TILE, cut, tiles
from detect.training.crops import Crops, mirrored, turned
from detect.training.dataset import box_of, share_inside, yolo_line
from mapping.grid import GridFrame, OccupancyGrid
from prim.metrics import polygon_iou
from prim.shapes import Kind, Primitive, angle_error
from prim.world import World

FRAME = GridFrame(0.01, -112, -112, TILE, TILE)
SHAPES = [
    Primitive(Kind.SQUARE, 0.1, -0.2, 0.4, (0.2,)),
    Primitive(Kind.RECTANGLE, 0.1, -0.2, 0.4, (0.3, 0.15)),
    Primitive(Kind.CIRCLE, 0.1, -0.2, None, (0.2,)),
    Primitive(Kind.TRIANGLE, 0.1, -0.2, 2.0, (0.2, 0.25)),
    Primitive(Kind.ELLIPSE, 0.1, -0.2, 2.4, (0.15, 0.06)),
]
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind.value)
every_preset = pytest.mark.parametrize("preset", [PAPER, PRIM], ids=lambda preset: preset.name)


def drawn(primitive: Primitive) -> np.ndarray:
    """A primitive as a solid grey image of the tile."""
    cells = (np.arange(TILE) - 112 + 0.5) * 0.01
    x, y = np.meshgrid(cells, cells)
    inside = shapely.contains_xy(shapely.Polygon(primitive.outline(256)), x, y)
    return np.where(inside, np.uint8(255), np.uint8(0))


@every_shape
@every_preset
def test_outputs_are_read_as_they_were_meant(shape: Primitive, preset: Preset) -> None:
    """Size, angle and place come back; the paper's preset puts the middle of the outline's box where the box is."""
    box = box_of(shape, FRAME)
    x, y = preset.centre(box, FRAME)
    outputs = targets(replace(shape, x=shape.x - x, y=shape.y - y), preset)
    assert len(outputs) == preset.outputs(shape.kind)
    found = read_outputs(shape.kind, outputs.tolist(), preset, box, FRAME)
    assert found.size == pytest.approx(shape.size, abs=1e-6)
    assert (found.x, found.y) == pytest.approx((shape.x, shape.y), abs=1e-6)
    assert angle_error(found, shape) in (None, pytest.approx(0, abs=1e-5))


def test_the_paper_s_outputs_and_ours() -> None:
    assert [PAPER.outputs(shape.kind) for shape in SHAPES] == [2, 3, 1, 3, 3]
    assert [PRIM.outputs(shape.kind) for shape in SHAPES] == [5, 6, 3, 6, 6]
    assert targets(SHAPES[2], PAPER) == pytest.approx([0.2 / LONGEST])


@every_shape
def test_the_box_is_around_what_is_drawn(shape: Primitive) -> None:
    rows, cols = np.nonzero(drawn(shape))
    left, top, right, bottom = box_of(shape, FRAME)
    assert (left, top, right, bottom) == pytest.approx(
        (cols.min(), rows.min(), cols.max() + 1, rows.max() + 1), abs=1.01
    )
    kind, *values = (float(value) for value in yolo_line(shape, FRAME).split())
    assert kind == list(Kind).index(shape.kind)
    points = np.array(values).reshape(-1, 2) * TILE
    assert (points[:, 0].min(), points[:, 1].max()) == pytest.approx((left, bottom), abs=1e-3)


@every_shape
@pytest.mark.parametrize("seed", range(8))
def test_what_varies_a_crop_varies_its_parameters(shape: Primitive, seed: int) -> None:
    """A crop that was mirrored and turned shows the primitive that its targets describe."""
    crops = Crops((drawn(shape),), ((0, FRAME, shape),))
    made, seen = crops.varied(0, PRIM, np.random.default_rng(seed))
    box = (TILE / 2 - 1, TILE / 2 - 1, TILE / 2 + 1, TILE / 2 + 1)
    told = read_outputs(shape.kind, targets(seen, PRIM).tolist(), PRIM, box, FRAME)
    assert (told.x, told.y) == pytest.approx((seen.x, seen.y), abs=1e-6)
    expected = crop(drawn(told), box, PRIM)
    assert np.count_nonzero(made != expected) / np.count_nonzero(expected) < 0.08


@given(theta=st.floats(0, 6.28), quarters=st.integers(0, 3))
def test_turning_and_mirroring_twice_is_nothing(theta: float, quarters: int) -> None:
    for kind, size in ((Kind.TRIANGLE, (0.2, 0.15)), (Kind.ELLIPSE, (0.2, 0.1)), (Kind.SQUARE, (0.2,))):
        shape = Primitive(kind, 0, 0, theta, size).canonical()
        for again in (mirrored(mirrored(shape)), turned(turned(shape, quarters), 4 - quarters)):
            assert angle_error(again, shape) == pytest.approx(0, abs=1e-6)


def test_the_papers_crop_is_alone_on_its_canvas() -> None:
    image = np.full((TILE, TILE), 255, np.uint8)
    made = crop(image, (100.0, 90.0, 120.0, 130.0), PAPER)
    assert made.shape == (50, 50)
    assert np.count_nonzero(made == 255) == pytest.approx(20 * 40 / 16, rel=0.3)
    assert made[0, 0] == 128


def test_a_crop_at_the_border_is_unknown_beyond_it() -> None:
    made = crop(np.zeros((TILE, TILE), np.uint8), (-10.0, -10.0, 10.0, 10.0), PRIM)
    assert (made[:36, :36] == 128).all() and (made[36:, 36:] == 0).all()


def test_tiles_cover_and_overlap() -> None:
    frame = GridFrame(0.01, -260, -130, 520, 260)
    found = list(tiles(frame))
    covered = np.zeros(frame.shape, bool)
    for tile in found:
        covered[max(tile.row - frame.row, 0) :, max(tile.col - frame.col, 0) :][: tile.rows, : tile.cols] = True
    assert covered.all()
    rows = sorted({tile.row for tile in found})
    assert max(np.diff(rows)) <= TILE - 80
    single = next(tiles(GridFrame(0.01, -110, -110, 220, 220)))
    assert (single.row, single.col) == (-112, -112)


def test_a_tile_beyond_the_map_is_unknown() -> None:
    grid = OccupancyGrid(GridFrame(0.01, 0, 0, 50, 60), np.ones((50, 60), np.float32))
    image = cut(grid, GridFrame(0.01, -10, -10, TILE, TILE))
    assert (image[10:60, 10:70, 0] == 255).all() and np.count_nonzero(image[..., 0] == 255) == 50 * 60
    assert (image[:10, :, 0] == 128).all() and (image[:10, :, 2] == 0).all()


def test_share_inside() -> None:
    circle = Primitive(Kind.CIRCLE, 1.12, 0.0, None, (0.1,))
    assert share_inside(circle, FRAME) == pytest.approx(0.5, abs=0.01)
    inside_but_for_2_mm = Primitive(Kind.SQUARE, 1.12 - 0.1 + 0.002, 0.0, 0.0, (0.2,))
    assert share_inside(inside_but_for_2_mm, FRAME) == pytest.approx(0.745, abs=0.001)
    only_its_base = Primitive(Kind.TRIANGLE, 1.12 + 0.09, 0.0, -np.pi / 2, (0.2, 0.3))
    assert share_inside(only_its_base, FRAME) == pytest.approx(0.266, abs=0.001)
    assert math.isclose(share_inside(SHAPES[0], FRAME), 1.0)
    assert World((2, 2), ()).bounds == (-1, -1, 1, 1)


@given(base=st.floats(0.1, 0.3), leg=st.floats(0.1, 0.3), theta=st.floats(0, 6.28), turn=st.floats(-0.02, 0.02))
def test_a_triangles_outputs_change_little_where_it_changes_little(
    base: float, leg: float, theta: float, turn: float
) -> None:
    """Also where it is nearly equilateral and its apex jumps: what a network learns has no tears."""
    assume(leg > base / 2 * 1.1)
    shape = Primitive(Kind.TRIANGLE, 0.3, -0.2, theta, (base, math.sqrt(leg**2 - base**2 / 4)))
    angle, (width, height) = read_triangle(triangle_outputs(shape))
    told = Primitive(Kind.TRIANGLE, 0.3, -0.2, angle, (width, height)).canonical()
    assert polygon_iou(told, shape) > 0.999
    other = replace(shape, theta=theta + turn, size=(shape.size[0] + turn / 10, shape.size[1]))
    assert np.abs(np.subtract(triangle_outputs(other), triangle_outputs(shape))).max() < 0.03
    third = replace(shape, theta=theta + 2 * math.pi / 3)
    if abs(base - leg) < 1e-6:
        assert triangle_outputs(third) == pytest.approx(triangle_outputs(shape), abs=1e-4)
