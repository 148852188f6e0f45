"""The morphology of grids against scipy and plain loops."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from mapping.grid import GridFrame
from mapping.morphology import beside_free, chessboard_distances, connected_components, dilate
from prim.arrays import BoolGrid

EIGHT, FOUR = np.ones((3, 3)), np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]])


def speckle(seed: int, share: float, most: int = 60) -> BoolGrid:
    rng = np.random.default_rng(seed)
    return rng.random(rng.integers(1, most, 2)) < share


def labelled(occupied: BoolGrid, most: int) -> tuple[np.ndarray, BoolGrid]:
    """Connected components with the limit in cells."""
    return connected_components(occupied, GridFrame(0.5, 0, 0, *occupied.shape), 0.5 * most)


@given(seed=st.integers(0, 10_000), share=st.floats(0, 0.6), most=st.integers(1, 40))
@settings(max_examples=50, deadline=None)
def test_connected_components_are_those_of_scipy_in_its_order(seed: int, share: float, most: int) -> None:
    occupied = speckle(seed, share)
    labels, large = labelled(occupied, most)
    expected, _ = ndimage.label(occupied, EIGHT)
    assert (labels == expected).all()
    spans = [max(part.stop - part.start for part in parts) for parts in ndimage.find_objects(expected)]
    assert (large == np.isin(expected, [k for k, span in enumerate(spans, start=1) if span > most])).all()


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_order_of_components_is_the_same_in_any_number_of_threads(threads: int) -> None:
    occupied = np.random.default_rng(0).random((700, 900)) < 0.3
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(threads)
        labels, _ = labelled(occupied, 40)
    finally:
        cv2.setNumThreads(before)
    assert (labels == ndimage.label(occupied, EIGHT)[0]).all()


@given(seed=st.integers(0, 10_000), steps=st.integers(0, 3))
def test_dilation_reaches_all_eight_neighbours(seed: int, steps: int) -> None:
    cells = speckle(seed, 0.08, 12)
    expected = np.zeros_like(cells)
    for row, col in zip(*np.nonzero(cells), strict=True):
        expected[max(row - steps, 0) : row + steps + 1, max(col - steps, 0) : col + steps + 1] = True
    assert (dilate(cells, steps) == expected).all()
    assert (dilate(cells.T, steps) == expected.T).all()


@given(seed=st.integers(0, 10_000), share=st.floats(0, 0.6))
def test_four_neighbours_are_beside_a_free_cell(seed: int, share: float) -> None:
    free = speckle(seed, share, 12)
    assert (beside_free(free) == ndimage.binary_dilation(free, FOUR)).all()


@given(seed=st.integers(0, 10_000), share=st.floats(0, 0.02))
@settings(max_examples=30, deadline=None)
def test_chessboard_distances_to_occupied_cells_or_beyond(seed: int, share: float) -> None:
    occupied = speckle(seed, share)
    others = np.pad(~occupied, 1)
    expected = ndimage.distance_transform_cdt(others, "chessboard")[1:-1, 1:-1]
    assert (chessboard_distances(occupied) == expected).all()


def test_distances_fit_one_byte() -> None:
    assert chessboard_distances(np.zeros((700, 700), np.bool_)).max() == 255


def test_opencv_is_loaded_when_it_is_needed() -> None:
    """What only maps, and scores no map, does without."""
    code = (
        "import sys, replay.pipeline\nfrom mapping.mapper import make_mapper\n"
        "make_mapper('det', 0.01, (-1.0, -1.0, 1.0, 1.0)).finish()\nassert 'cv2' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
