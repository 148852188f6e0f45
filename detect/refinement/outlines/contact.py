"""Whether a candidate is a part of something larger: what is connected with it in the map goes on beyond it.

Occupied cells that touch a candidate, and that neither another primitive nor a straight wall explains, are held
against the rays that pass the candidate: how much likelier are these with the cells than without?
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.refinement.likelihood.geometry import passes_within
from detect.refinement.likelihood.kernels import BACKGROUND
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import (
    BeamModel,
    DistanceMap,
    background_log_likelihood,
    occlusion_by,
    with_background,
)
from detect.refinement.options import DEFAULTS, ContactOptions
from detect.refinement.surroundings.map_cells import OUTLINE_POINTS, MapCells, is_within
from detect.refinement.surroundings.walls import Wall
from mapping.morphology import label
from prim.arrays import BoolGrid, FloatArray
from prim.shapes import Primitive


@dataclass(frozen=True)
class Contact:
    """What touches a candidate.

    Attributes:
        nats: By how much its rays are likelier with what touches it.
        cells: How many cells that are.
    """

    nats: float = 0.0
    cells: int = 0


def contact_of(
    primitive: Primitive,
    bundle: RayBundle,
    cells: MapCells,
    others: Sequence[Primitive],
    walls: Sequence[Wall],
    sensor: BeamModel,
    options: ContactOptions = DEFAULTS.contact,
) -> Contact:
    """Weigh what is connected with a candidate in the map, and that neither primitives nor walls explain.

    Args:
        primitive: The candidate.
        bundle: Its rays.
        cells: The map.
        others: The other primitives.
        walls: Straight walls near it.
        sensor: The sensor.
        options: Numeric parameters.

    Returns:
        The contact.
    """
    near = [other for other in others if centres_within(other, primitive, options.occluder_distance)]
    good = [wall for wall in walls if _explains(wall, primitive, cells, options)]
    touching = _touching_cells(primitive, cells, near, good, options)
    if touching is None:
        return Contact()
    occupied = cells.without([primitive, *near], options.cleared)
    for wall in good:
        occupied[wall.cells] = False
    occupied[touching] = True
    without = occupied.copy()
    without[touching] = False
    passing = bundle.select(~passes_within(primitive, bundle.rays, options.passing))
    occluders = [*near, *(wall.stretch for wall in good)]
    with_cells, without_cells = (
        _log_likelihood(passing, state, cells, occluders, sensor) for state in (occupied, without)
    )
    return Contact((with_cells - without_cells) / sensor.dispersion, len(touching[0]))


def is_flush(primitive: Primitive, cells: MapCells, options: ContactOptions = DEFAULTS.contact) -> bool:
    """Tell whether one side of a primitive is flush with a wall or something large: no ray saw what is between.

    Args:
        primitive: The primitive.
        cells: The map.
        options: Numeric parameters.

    Returns:
        Whether one is; never of round ones.
    """
    if primitive.is_round:
        return False
    corners = primitive.outline()
    return any(
        _is_side_flush(corner, following, cells, options)
        for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    )


def _is_side_flush(first: FloatArray, last: FloatArray, cells: MapCells, options: ContactOptions) -> bool:
    """Tell whether nowhere along a side, its ends left out, a free cell is beside it, but large things' cells are."""
    frame, resolution = cells.frame, cells.frame.resolution
    length = float(np.hypot(*(last - first)))
    along = (last - first) / length
    places = np.arange(options.side_ends * resolution, length - options.side_ends * resolution, resolution)
    if len(places) < options.side_cells:
        return False
    away = np.array([along[1], -along[0]])
    depths = np.array(options.side_strip) * resolution
    points = first + places[:, None, None] * along + depths[:, None] * away
    col, row = np.moveaxis(np.floor(points / resolution).astype(int) - [frame.col, frame.row], -1, 0)
    inside = (row >= 0) & (row < frame.rows) & (col >= 0) & (col < frame.cols)
    row, col = np.clip(row, 0, frame.rows - 1), np.clip(col, 0, frame.cols - 1)
    free, taken = cells.free[row, col] & inside, cells.large[row, col] & inside
    for wall in cells.walls:
        taken |= wall.contains(points, options.flush_wall * resolution, 0.0)
    unseen, beside = ~free.any(axis=1), taken.any(axis=1)
    return bool(unseen.mean() > options.flush_share and beside.mean() > options.flush_share)


def centres_within(a: Primitive, b: Primitive, reach: float) -> bool:
    """Tell whether two primitives' centroids are no further apart than ``reach`` (m).

    Args:
        a: One.
        b: The other.
        reach: The distance (m).

    Returns:
        Whether they are.
    """
    return math.hypot(a.x - b.x, a.y - b.y) <= reach


def _log_likelihood(
    bundle: RayBundle, occupied: BoolGrid, cells: MapCells, occluders: Sequence[Primitive], sensor: BeamModel
) -> float:
    """Return the log-likelihood (nats) of rays that meet nothing but the map and the occluders."""
    background = DistanceMap.of(occupied, cells.frame).background(bundle)
    likelihood = background_log_likelihood(bundle, background, sensor)
    occlusion = occlusion_by(bundle, occluders)
    return float(with_background(bundle, background, likelihood, occlusion, sensor).rays[BACKGROUND].sum())


def _explains(wall: Wall, primitive: Primitive, cells: MapCells, options: ContactOptions) -> bool:
    """Tell whether a wall may be what touches a primitive: it is not cut by it, and the strip beside it is free."""
    nx, ny, d = wall.line
    if wall.is_cut_by(primitive):
        return False
    outline = primitive.outline(OUTLINE_POINTS)
    least = max(options.wall_depth, options.wall_depth_cells * cells.frame.resolution)
    return bool((outline @ np.array([nx, ny]) - d).min() > -least) and _is_free_beside(wall, outline, cells, options)


def _is_free_beside(wall: Wall, outline: FloatArray, cells: MapCells, options: ContactOptions) -> bool:
    """Tell whether what is beside a primitive along a wall, on its side of the wall, is free."""
    frame, resolution = cells.frame, cells.frame.resolution
    nx, ny, d = wall.line
    along = outline @ np.array([-ny, nx])
    middle, half = -ny * wall.stretch.x + nx * wall.stretch.y, wall.stretch.size[0] / 2
    places = np.arange(middle - half, middle + half, resolution)
    margin = options.beside * resolution
    places = places[(places < along.min() - margin) | (places > along.max() + margin)]
    if not len(places):
        return True
    offsets = np.array(options.strip) * resolution
    points = np.array([nx, ny]) * (d + offsets[:, None, None]) + places[:, None] * np.array([-ny, nx])
    col, row = np.moveaxis(np.floor(points / resolution).astype(int) - [frame.col, frame.row], -1, 0)
    inside = (row >= 0) & (row < frame.rows) & (col >= 0) & (col < frame.cols)
    free = cells.free[np.clip(row, 0, frame.rows - 1), np.clip(col, 0, frame.cols - 1)] & inside
    return bool(free.mean() > options.free_share)


def _touching_cells(
    primitive: Primitive,
    cells: MapCells,
    others: Sequence[Primitive],
    walls: Sequence[Wall],
    options: ContactOptions,
) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """Return rows and columns of the unexplained occupied cells connected with a primitive; None where none is."""
    resolution = cells.frame.resolution
    far = max(options.far, options.far_cells * resolution)
    rows, cols, points = cells.around(primitive, primitive.bounding_radius + far)
    unexplained = cells.occupied[rows, cols].copy()
    for other in others:
        unexplained &= ~is_within(other, points, max(options.own, options.own_cells * resolution))
    for wall in walls:
        nx, ny, d = wall.line
        width = max(options.wall_width, options.wall_width_cells * resolution)
        unexplained &= np.abs(points @ np.array([nx, ny]) - d) >= width
    outline, depth = primitive.outline(OUTLINE_POINTS), max(options.wall_depth, options.wall_depth_cells * resolution)
    width = max(options.wall_width, options.wall_width_cells * resolution)
    for straight in cells.walls:
        if not straight.hides(outline, depth, 0.0):
            unexplained &= ~straight.contains(points, width, options.wall_extension)
    for straight in cells.thin_walls:
        if straight.is_beside(outline, depth):
            unexplained &= ~straight.contains(points, width, options.wall_extension)
    at_edge, touch, inside = (
        is_within(primitive, points, margin)
        for margin in (options.edge * resolution, options.touch * resolution, 0.0)
    )
    labels = label(unexplained)
    connected = np.unique(labels[unexplained & touch & ~at_edge])
    taken = unexplained & np.isin(labels, connected) & ~inside & is_within(primitive, points, far)
    if not taken.any():
        return None
    at_rows, at_cols = np.nonzero(taken)
    return at_rows + rows.start, at_cols + cols.start
