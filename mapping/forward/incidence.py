"""Stopping probabilities by the direction of a ray: one trial for each cell that a ray gains in depth into a surface.

A map of stopping probabilities gives a ray one trial a step along its major axis. A ray that grazes a surface takes
several steps for each cell that it gains in depth, and so is expected to end too soon: by centimetres, on surfaces
that noise makes several cells thick. Scans that are matched with such a map are pulled away from the walls nearby,
which they see at all angles, by some 5 mm a metre. Here a step counts as a part of a trial: as the depth that the ray
gains in it along the surface's normal, in cells, where the map has a normal there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray


@dataclass(frozen=True)
class IncidenceOptions:
    """The numbers of :func:`directional_stopping`; set by hand.

    Attributes:
        directions: Half a turn is divided into so many directions of rays.
        edge_blur: Width (cells) of the Gaussian that the map is smoothed with before its slopes are taken.
        tensor_blur: Width (cells) of the Gaussian over which products of slopes are averaged.
        max_stopping: Stopping probabilities count as no more than this.
    """

    directions: int = 12
    edge_blur: float = 1.0
    tensor_blur: float = 1.5
    max_stopping: float = 0.999999


DEFAULTS = IncidenceOptions()


def directional_stopping(stopping: NDArray[np.float32], options: IncidenceOptions = DEFAULTS) -> NDArray[np.float32]:
    """Compute a map's stopping probabilities for rays of several directions.

    Args:
        stopping: The probabilities (rows, cols) that a ray ends in a cell once it is there.
        options: How many directions, and how normals are found.

    Returns:
        (directions, rows, cols): number k for rays about the angle k pi / directions (rad) and its opposite.
    """
    normals, coherence = surface_normals(stopping, options)
    passing = np.log1p(-np.minimum(stopping, np.float32(options.max_stopping)))
    maps = np.empty((options.directions, *stopping.shape), np.float32)
    for k in range(options.directions):
        angle = math.pi * k / options.directions
        step = 1 / max(abs(math.cos(angle)), abs(math.sin(angle)))  # cells
        trials = 1 - coherence * (1 - np.minimum(step * np.abs(np.cos(angle - normals)), 1))
        # nor does a ray that grazes a solid surface end in the first step that it takes there: its mean depth is that
        # of one straight on, half a cell
        maps[k] = np.minimum(-np.expm1(trials * passing), 2 * trials / (1 + trials))
    return maps


def surface_normals(
    stopping: NDArray[np.float32], options: IncidenceOptions = DEFAULTS
) -> tuple[FloatArray, FloatArray]:
    """Find the normals of a map's surfaces by its structure tensor (Foerstner and Guelch, 1987).

    Args:
        stopping: Stopping probabilities (rows, cols).
        options: Widths.

    Returns:
        The normals' angles (rows, cols) in rad, up to half a turn; and the tensor's coherence (rows, cols): from 0
        where there is no one direction to 1 where there is one only.
    """
    import cv2

    smooth = cv2.GaussianBlur(stopping, (0, 0), options.edge_blur)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))]
    xx, xy, yy = (
        cv2.GaussianBlur(a * b, (0, 0), options.tensor_blur)
        for a, b in ((slopes[0], slopes[0]), (slopes[0], slopes[1]), (slopes[1], slopes[1]))
    )
    across, trace = np.hypot(xx - yy, 2 * xy), xx + yy
    normals: FloatArray = np.arctan2(2 * xy, xx - yy) / 2
    coherence: FloatArray = np.divide(across, trace, out=np.zeros_like(trace), where=trace > 0)
    return normals, coherence
