"""Drawings of primitives that training starts from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.networks.tiles import TILE_SIZE
from detect.training.drawings import FRAME, DrawingOptions, draw_primitives, make_drawings
from prim.errors import OutputError, UsageError


def test_outlines_are_mostly_occupied_and_what_they_enclose_unknown() -> None:
    """Noise, blur and occlusion are drawn at random: on average over many drawings."""
    shares = []
    for seed in range(60):
        image, primitives = draw_primitives(np.random.default_rng(seed))
        assert image.shape == (TILE_SIZE, TILE_SIZE, 3) and image.dtype == np.uint8
        for primitive in primitives:
            centre = np.array([primitive.x, primitive.y])
            around = primitive.outline() - centre
            steps = FRAME.resolution * around / np.linalg.norm(around, axis=1, keepdims=True)
            on, inside, outside = (_cells(image, centre + around + 3 * k * steps) for k in (0, -1, 1))
            shares.append([(on > 128).mean(), (inside == 128).mean(), (outside < 128).mean()])
    occupied, unknown, free = np.mean(shares, axis=0)
    assert occupied > 0.85 and unknown > 0.3 and free > 0.7


def _cells(image: NDArray[np.uint8], points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The first channel at points (N, 2) of the map frame."""
    cols, rows = np.clip(np.floor(points / FRAME.resolution).astype(int), 0, TILE_SIZE - 1).T
    return image[rows, cols, 0]


def test_drawings_are_continued(tmp_path: Path) -> None:
    options = DrawingOptions(sizes=(3, 1), seed=5)
    assert make_drawings(tmp_path, options) == 4
    first = sorted(tmp_path.rglob("*.png"))[0]
    before = first.read_bytes()
    first.unlink()
    assert make_drawings(tmp_path, options) == 1 and first.read_bytes() == before
    with pytest.raises(UsageError, match="other options"):
        make_drawings(tmp_path, DrawingOptions(sizes=(3, 1), seed=6))


def test_a_drawing_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "images" / "drawings" / "train" / "000005.png" / "folder").mkdir(parents=True)
    (tmp_path / "labels" / "drawings" / "train" / "000006.txt").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"000006\.txt: cannot write"):
        make_drawings(tmp_path, DrawingOptions(sizes=(2, 0), seed=5))
