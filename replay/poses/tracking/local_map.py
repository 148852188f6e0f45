"""A map of the points of some scans, that others are matched with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prim.arrays import FloatArray
from replay.poses.tracking.kernels import (
    Excluded,
    Fit,
    Grid,
    Window,
    add_residuals,
    fit_pose,
    note_nearest,
    pool_scores,
    score_cells,
    search_pose,
)
from replay.poses.tracking.options import LocalMapOptions

NO_PRIOR = np.zeros((3, 3))

NOTHING = Excluded()
"""No pose is left out of a search."""


class Match(NamedTuple):
    """How a scan fits a map.

    Attributes:
        pose: (3,) where it fits best: x, y (m), heading (rad).
        information: (3, 3) on the pose, by residuals of the standard deviation that LocalMapOptions has.
        score: The share of its points that lie on the map, as Welsch's weights count them.
        spread: Root mean square (m) of the residuals on lines.
    """

    pose: FloatArray
    information: FloatArray
    score: float
    spread: float


class LocalMap:
    """The nearest of some points, by cells.

    Args:
        points: (M, 4) x, y (m) and unit normals, in the map's frame.
        options: Cells, kernels, windows.
    """

    def __init__(self, points: FloatArray, options: LocalMapOptions) -> None:
        self._points, self._options = points, options
        low, high = points[:, :2].min(axis=0) - options.margin, points[:, :2].max(axis=0) + options.margin
        cols, rows = np.minimum(np.ceil((high - low) / options.cell).astype(int) + 1, options.most_cells).tolist()
        self._grid = Grid(float(low[0]), float(low[1]), options.cell)
        self._squares = np.full((rows, cols), np.inf, np.float32)
        self._nearest = np.full((rows, cols), -1, np.int32)
        note_nearest(points, self._grid, options.reach, self._squares, self._nearest)
        self._scores: FloatArray | None = None
        widths = np.ones(options.steps + 1)
        widths[: len(options.widening)] = options.widening
        self._fit = Fit(
            options.kernel * widths, options.residual, options.min_cosine, options.point_weight, options.enough
        )

    def match(
        self,
        points: FloatArray,
        pose: FloatArray,
        prior: FloatArray | None = None,
        information: FloatArray = NO_PRIOR,
    ) -> Match:
        """Fit a scan to the map.

        Args:
            points: (N, 4) of the scan.
            pose: (3,) to begin at.
            prior: (3,) the mean of the pose's prior; None: where it begins.
            information: (3, 3) of the prior.

        Returns:
            The match.
        """
        at, own = pose.astype(float), np.empty((3, 3))
        prior = at.copy() if prior is None else prior
        score, squares, weights = fit_pose(
            points, self._points, self._nearest, self._grid, self._fit, prior, information, at, own
        )
        return Match(at, own, score / max(len(points), 1), float(np.sqrt(squares / weights)) if weights > 0 else 0.0)

    def score(self, points: FloatArray, pose: FloatArray) -> float:
        """Measure how well a scan fits the map.

        Args:
            points: (N, 4) of the scan.
            pose: (3,).

        Returns:
            From 0 to 1, as :attr:`Match.score`.
        """
        information, vector = np.empty((3, 3)), np.empty(3)
        width = self._fit.kernels[-1]
        at = pose.astype(float)
        found = add_residuals(
            points, at, self._points, self._nearest, self._grid, self._fit, width, information, vector
        )
        return float(found[0]) / max(len(points), 1)

    def search(
        self, points: FloatArray, middle: FloatArray, window: Window, levels: int, least: float = 0.0
    ) -> FloatArray | None:
        """Search for a scan in the map.

        Args:
            points: (N, 4) of the scan, thinned.
            middle: (3,) the middle of the window.
            window: What is searched.
            levels: How many levels of coarser scores are used.
            least: The least score.

        Returns:
            The pose (3,) of the best score; None where none is above the least.
        """
        found = self.find(points, middle, window, levels, least)
        return None if found is None else found[0]

    def find(
        self,
        points: FloatArray,
        middle: FloatArray,
        window: Window,
        levels: int,
        least: float,
        excluded: Excluded = NOTHING,
    ) -> tuple[FloatArray, float] | None:
        """Search for a scan in the map, but for some poses.

        Args:
            points: (N, 4) of the scan, thinned.
            middle: (3,) the middle of the window.
            window: What is searched.
            levels: How many levels of coarser scores are used.
            least: The least score.
            excluded: The poses that are left out.

        Returns:
            The pose (3,) of the best score, and this; None where none is above the least.
        """
        if not len(points):
            return None
        found = np.zeros(3)
        score = search_pose(points, self._pyramid(levels), self._grid, middle, window, excluded, least, found)
        return (found, float(score)) if score > 0 else None

    def _pyramid(self, levels: int) -> FloatArray:
        """Return scores of cells (levels + 1, rows, cols): at each level maxima over squares of the one before."""
        if self._scores is None or len(self._scores) <= levels:
            self._scores = np.empty((levels + 1, *self._squares.shape), np.uint8)
            score_cells(self._squares, self._options.blur, self._scores[0])
            for level in range(levels):
                pool_scores(self._scores[level], 1 << level, self._scores[level + 1])
        return self._scores[: levels + 1]


def joined(scans: Sequence[FloatArray]) -> FloatArray:
    """Join the points of several scans.

    Args:
        scans: Points (N, 4) of each.

    Returns:
        All of them as one array.
    """
    return np.concatenate(scans) if scans else np.zeros((0, 4))
