"""Crops, the encoding of parameters, their augmentation, and tiles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from detect.networks.parameters import (
    LENGTH_UNIT,
    PAPER,
    PRIM,
    Preset,
    crop_box,
    decode_parameters,
    decode_triangle,
    encode_parameters,
    encode_triangle,
)
from detect.networks.tiles import TILE_SIZE, tile_frames, tile_image
from detect.training.crops import CropSamples, mirror, rotate_by_quarters
from detect.training.dataset import bounding_box, share_inside, yolo_label
from mapping.grid import GridFrame, OccupancyGrid
from prim.metrics import polygon_iou
from prim.shapes import Kind, Primitive, angle_error
from prim.world import World

FRAME = GridFrame(0.01, -112, -112, TILE_SIZE, TILE_SIZE)
SHAPES = [
    Primitive(Kind.SQUARE, 0.1, -0.2, 0.4, (0.2,)),
    Primitive(Kind.RECTANGLE, 0.1, -0.2, 0.4, (0.3, 0.15)),
    Primitive(Kind.CIRCLE, 0.1, -0.2, None, (0.2,)),
    Primitive(Kind.TRIANGLE, 0.1, -0.2, 2.0, (0.2, 0.25)),
    Primitive(Kind.ELLIPSE, 0.1, -0.2, 2.4, (0.15, 0.06)),
]
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.kind.value)
every_preset = pytest.mark.parametrize("preset", [PAPER, PRIM], ids=lambda preset: preset.name)


def rasterised(primitive: Primitive) -> np.ndarray:
    """The tile's grey image of a solid primitive."""
    cells = (np.arange(TILE_SIZE) - 112 + 0.5) * 0.01
    x, y = np.meshgrid(cells, cells)
    inside = shapely.contains_xy(shapely.Polygon(primitive.outline(256)), x, y)
    return np.where(inside, np.uint8(255), np.uint8(0))


@every_shape
@every_preset
def test_decoding_inverts_encoding(shape: Primitive, preset: Preset) -> None:
    """Of size, angle and position; the paper's preset centres the outline's bounding box on the box."""
    box = bounding_box(shape, FRAME)
    x, y = preset.window_centre(box, FRAME)
    outputs = encode_parameters(replace(shape, x=shape.x - x, y=shape.y - y), preset)
    assert len(outputs) == preset.output_count(shape.kind)
    found = decode_parameters(shape.kind, outputs.tolist(), preset, box, FRAME)
    assert found.size == pytest.approx(shape.size, abs=1e-6)
    assert (found.x, found.y) == pytest.approx((shape.x, shape.y), abs=1e-6)
    assert angle_error(found, shape) in (None, pytest.approx(0, abs=1e-5))


def test_numbers_of_outputs() -> None:
    assert [PAPER.output_count(shape.kind) for shape in SHAPES] == [2, 3, 1, 3, 3]
    assert [PRIM.output_count(shape.kind) for shape in SHAPES] == [5, 6, 3, 6, 6]
    assert encode_parameters(SHAPES[2], PAPER) == pytest.approx([0.2 / LENGTH_UNIT])


@every_shape
def test_bounding_box_and_label_agree_with_the_image(shape: Primitive) -> None:
    rows, cols = np.nonzero(rasterised(shape))
    left, top, right, bottom = bounding_box(shape, FRAME)
    assert (left, top, right, bottom) == pytest.approx(
        (cols.min(), rows.min(), cols.max() + 1, rows.max() + 1), abs=1.01
    )
    kind, *values = (float(value) for value in yolo_label(shape, FRAME).split())
    assert kind == list(Kind).index(shape.kind)
    points = np.array(values).reshape(-1, 2) * TILE_SIZE
    assert (points[:, 0].min(), points[:, 1].max()) == pytest.approx((left, bottom), abs=1e-3)


@every_shape
@pytest.mark.parametrize("seed", range(8))
def test_augmentation_transforms_crop_and_parameters_alike(shape: Primitive, seed: int) -> None:
    """A mirrored and rotated crop shows the primitive that its targets encode."""
    crops = CropSamples((rasterised(shape),), ((0, FRAME, shape),))
    augmented, relative = crops.augmented(0, PRIM, np.random.default_rng(seed))
    box = (TILE_SIZE / 2 - 1, TILE_SIZE / 2 - 1, TILE_SIZE / 2 + 1, TILE_SIZE / 2 + 1)
    decoded = decode_parameters(shape.kind, encode_parameters(relative, PRIM).tolist(), PRIM, box, FRAME)
    assert (decoded.x, decoded.y) == pytest.approx((relative.x, relative.y), abs=1e-6)
    expected = crop_box(rasterised(decoded), box, PRIM)
    assert np.count_nonzero(augmented != expected) / np.count_nonzero(expected) < 0.08


@given(theta=st.floats(0, 6.28), quarters=st.integers(0, 3))
def test_mirroring_twice_and_rotating_back_are_the_identity(theta: float, quarters: int) -> None:
    for kind, size in ((Kind.TRIANGLE, (0.2, 0.15)), (Kind.ELLIPSE, (0.2, 0.1)), (Kind.SQUARE, (0.2,))):
        shape = Primitive(kind, 0, 0, theta, size).canonical()
        for again in (mirror(mirror(shape)), rotate_by_quarters(rotate_by_quarters(shape, quarters), 4 - quarters)):
            assert angle_error(again, shape) == pytest.approx(0, abs=1e-6)


def test_the_papers_crop_is_isolated() -> None:
    image = np.full((TILE_SIZE, TILE_SIZE), 255, np.uint8)
    made = crop_box(image, (100.0, 90.0, 120.0, 130.0), PAPER)
    assert made.shape == (50, 50)
    assert np.count_nonzero(made == 255) == pytest.approx(20 * 40 / 16, rel=0.3)
    assert made[0, 0] == 128


def test_a_crop_at_the_border_is_unknown_beyond_it() -> None:
    made = crop_box(np.zeros((TILE_SIZE, TILE_SIZE), np.uint8), (-10.0, -10.0, 10.0, 10.0), PRIM)
    assert (made[:36, :36] == 128).all() and (made[36:, 36:] == 0).all()


@given(
    seed=st.integers(0, 10_000), x=st.floats(-150, 370), y=st.floats(-150, 370), preset=st.sampled_from((PRIM, PAPER))
)
@settings(max_examples=60, deadline=None)
def test_a_crop_holds_the_cells_of_its_window(seed: int, x: float, y: float, preset: Preset) -> None:
    """Cell by cell, also of boxes beyond the tile; a pixel is the mean of its block of cells."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (TILE_SIZE, TILE_SIZE), dtype=np.uint8)
    width, height = rng.uniform(0, 90, 2)
    box = x - width, y - height, x + width, y + height
    col, row = preset.window_origin(box)
    rows, cols = np.indices((preset.window, preset.window)) + np.array([row, col])[:, None, None]
    shown = (rows >= 0) & (rows < TILE_SIZE) & (cols >= 0) & (cols < TILE_SIZE)
    if preset.isolated:
        shown &= (rows >= math.floor(box[1]) - 1) & (rows < math.ceil(box[3]) + 1)
        shown &= (cols >= math.floor(box[0]) - 1) & (cols < math.ceil(box[2]) + 1)
    cells = np.where(shown, image[np.clip(rows, 0, TILE_SIZE - 1), np.clip(cols, 0, TILE_SIZE - 1)], 128)
    block = preset.window // preset.pixels
    means = cells.reshape(preset.pixels, block, preset.pixels, block).mean(axis=(1, 3))
    assert (crop_box(image, box, preset) == np.rint(means)).all()


def test_tiles_cover_and_overlap() -> None:
    frame = GridFrame(0.01, -260, -130, 520, 260)
    found = list(tile_frames(frame))
    covered = np.zeros(frame.shape, bool)
    for tile in found:
        covered[max(tile.row - frame.row, 0) :, max(tile.col - frame.col, 0) :][: tile.rows, : tile.cols] = True
    assert covered.all()
    rows = sorted({tile.row for tile in found})
    assert max(np.diff(rows)) <= TILE_SIZE - 80
    single = next(tile_frames(GridFrame(0.01, -110, -110, 220, 220)))
    assert (single.row, single.col) == (-112, -112)


def test_cells_beyond_the_map_are_unknown() -> None:
    grid = OccupancyGrid(GridFrame(0.01, 0, 0, 50, 60), np.ones((50, 60), np.float32))
    image = tile_image(grid, GridFrame(0.01, -10, -10, TILE_SIZE, TILE_SIZE))
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
def test_the_encoding_of_triangles_is_continuous(base: float, leg: float, theta: float, turn: float) -> None:
    """Also where a triangle is nearly equilateral and another corner becomes the apex."""
    assume(leg > base / 2 * 1.1)
    shape = Primitive(Kind.TRIANGLE, 0.3, -0.2, theta, (base, math.sqrt(leg**2 - base**2 / 4)))
    angle, (width, height) = decode_triangle(encode_triangle(shape))
    decoded = Primitive(Kind.TRIANGLE, 0.3, -0.2, angle, (width, height)).canonical()
    assert polygon_iou(decoded, shape) > 0.999
    other = replace(shape, theta=theta + turn, size=(shape.size[0] + turn / 10, shape.size[1]))
    assert np.abs(np.subtract(encode_triangle(other), encode_triangle(shape))).max() < 0.03
    third = replace(shape, theta=theta + 2 * math.pi / 3)
    if abs(base - leg) < 1e-6:
        assert encode_triangle(third) == pytest.approx(encode_triangle(shape), abs=1e-4)
