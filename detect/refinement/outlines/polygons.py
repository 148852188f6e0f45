"""Free polygons: the contour of a candidate's cells, fitted to its rays with as many vertices as these support.

Unlike a deformed primitive (detect.refinement.outlines.free_outline) a polygon has sharp corners and need not be
star-shaped: L, U, cross. It loses vertices one by one while its evidence rises. The prior: vertices are normally
distributed about the first, whose place is as open as a primitive's; each further vertex halves the probability.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detect.refinement.likelihood.kernels import RayData
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, Descent, PolygonOptions
from detect.refinement.outlines.kernels import NO_GRADIENT, NO_INFORMATION, outline_likelihood
from detect.refinement.surroundings.map_cells import MapCells, is_within
from detect.refinement.surroundings.walls import Wall
from mapping.morphology import component_around, outer_contour
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.shapes import Primitive


@dataclass(frozen=True)
class PolygonFit:
    """A polygon fitted to rays.

    Attributes:
        vertices: (V, 2) in m, map frame, counter-clockwise.
        log_evidence: Nats, comparable with that of kinds.
        std: Standard deviation (m) of the outline across it; the median over its vertices.
    """

    vertices: FloatArray
    log_evidence: float
    std: float


def polygon_starts(primitives: Sequence[Primitive], options: PolygonOptions = DEFAULTS.polygon) -> list[FloatArray]:
    """Return polygons of few vertices that begin as fitted primitives: triangles, quadrilaterals, of round ones more.

    Args:
        primitives: The fitted kinds.
        options: How many vertices stand for round ones.

    Returns:
        Vertices (V, 2) in m of each.
    """
    made = [primitive.outline() for primitive in primitives if not primitive.is_round]
    rounds = [primitive for primitive in primitives if primitive.is_round]
    return made + [rounds[0].outline(count) for count in options.round_vertices if rounds]


def contour_of(
    primitive: Primitive,
    cells: MapCells,
    others: Sequence[Primitive],
    walls: Sequence[Wall],
    options: PolygonOptions = DEFAULTS.polygon,
) -> FloatArray | None:
    """Return the contour of the cells that are not free where a candidate stands.

    Args:
        primitive: The candidate.
        cells: The map.
        others: Other candidates: their cells are left out.
        walls: Walls behind candidates, left out too.
        options: Numeric parameters.

    Returns:
        Vertices (V, 2) in m, counter-clockwise; None where there is no such cell, or far too many vertices.
    """
    resolution = cells.frame.resolution
    reach = primitive.bounding_radius + max(options.around, options.around_cells * resolution)
    rows, cols, points = cells.around(primitive, reach)
    solid = ~cells.free[rows, cols]
    if not solid.size:
        return None
    for other in others:
        if math.hypot(other.x - primitive.x, other.y - primitive.y) < reach + other.bounding_radius:
            solid &= ~is_within(other, points, options.others * resolution)
    for wall in walls:
        nx, ny, d = wall.line
        offset = points @ np.array([nx, ny]) - d
        side = 1.0 if nx * primitive.x + ny * primitive.y > d else -1.0
        solid &= side * offset > options.wall * resolution
    component = component_around(solid, is_within(primitive, points, 0.0))
    if component is None:
        return None
    corner = points[0, 0] - 0.5 * resolution
    vertices = corner + resolution * outer_contour(component, options.simplification)
    return vertices if options.vertices[0] <= len(vertices) <= options.vertices[1] else None


def fit_polygons(
    starts: Sequence[FloatArray], bundle: RayBundle, sensor: BeamModel, options: PolygonOptions = DEFAULTS.polygon
) -> PolygonFit:
    """Fit polygons to rays, and remove vertices as long as the evidence rises.

    Args:
        starts: The first vertices (V, 2) in m of each, one at least.
        bundle: The rays.
        sensor: The sensor.
        options: Numeric parameters.

    Returns:
        The polygon of the largest evidence.
    """
    stride = max(1, len(bundle) // options.search_rays)
    data = sensor.data(bundle.select(slice(None, None, stride)))
    fits = [_reduced(start, data, stride, sensor, options) for start in starts]
    best = max(fits, key=lambda fit: fit.log_evidence)
    return _descend(best.vertices, sensor.data(bundle), 1, sensor, options.fine, options)


def _reduced(start: FloatArray, data: RayData, stride: int, sensor: BeamModel, options: PolygonOptions) -> PolygonFit:
    """Fit a polygon, and remove vertices as long as the evidence rises."""
    best = _descend(start, data, stride, sensor, options.coarse, options)
    while len(best.vertices) > options.vertices[0]:
        simpler = _without_a_vertex(best, data, stride, sensor, options)
        if simpler is None:
            break
        best = simpler
    return best


def _without_a_vertex(
    fit: PolygonFit, data: RayData, stride: int, sensor: BeamModel, options: PolygonOptions
) -> PolygonFit | None:
    """Return a better fit with a vertex less, those that span small triangles first; None if none is."""
    before, after = (np.roll(fit.vertices, turn, axis=0) - fit.vertices for turn in (1, -1))
    area = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
    for corner in np.argsort(area, kind="stable")[: options.tries].tolist():
        fewer = np.delete(fit.vertices, corner, axis=0)
        made = _descend(fewer, data, stride, sensor, options.reduction, options)
        if made.log_evidence > fit.log_evidence:
            return made
    return None


def _descend(
    start: FloatArray, data: RayData, stride: int, sensor: BeamModel, descent: Descent, options: PolygonOptions
) -> PolygonFit:
    """Fit vertices by Levenberg and Marquardt's method; evidence by Laplace's, scaled to all rays."""
    scale = stride / sensor.dispersion
    size = start.size
    pull = 1 / options.pull**2
    vertices, gradient, information = start.copy(), np.zeros(size), np.zeros((size, size))
    least = max(sensor.footprint, options.least_blur)
    for blur in dict.fromkeys(max(blur, least) for blur in descent.blurs):
        damping, objective, trial = options.first_damping, math.inf, vertices
        slope, curvature = np.zeros(size), np.eye(size)
        for _ in range(descent.steps + 1):
            cost = scale * outline_likelihood(trial, data, blur, gradient, information)
            found = cost + 0.5 * pull * float(((trial - start) ** 2).sum())
            if found < objective:
                gain, objective, vertices = objective - found, found, trial
                slope = scale * gradient + pull * (vertices - start).ravel()
                curvature = scale * information + pull * np.eye(size)
                damping = max(damping * options.damping_after_success, options.min_damping)
                if gain < descent.tolerance:
                    break
            else:
                damping *= options.damping_after_failure
                if damping > options.max_damping:
                    break
            step = linear_algebra.solve(curvature + damping * np.diag(np.diag(curvature)), slope)
            if step is None:
                break
            trial = vertices - step.reshape(-1, 2)
    return _evaluated(vertices, data, scale, least, options)


def _evaluated(vertices: FloatArray, data: RayData, scale: float, blur: float, options: PolygonOptions) -> PolygonFit:
    """Return a fitted polygon with its evidence, approximated by Laplace's method, and its uncertainty."""
    count, size = len(vertices), vertices.size
    cost = scale * outline_likelihood(vertices, data, blur, NO_GRADIENT, NO_INFORMATION)
    gradient, information = np.zeros(size), np.zeros((size, size))
    outline_likelihood(vertices, data, max(blur, options.information_blur), gradient, information)
    variance = options.spread**2
    precision = scale * information + np.eye(size) / variance
    logarithm, covariance = linear_algebra.log_determinant(precision), linear_algebra.inverse(precision)
    if logarithm is None or covariance is None:
        return PolygonFit(vertices, -math.inf, math.inf)
    volume = count * math.log(2 * math.pi) - 0.5 * logarithm
    prior = -(count - 1) * math.log(2 * math.pi * variance) - count * math.log(options.vertex_odds)
    return PolygonFit(vertices, float(-cost + volume + prior), std_across(vertices, covariance))


def std_across(vertices: FloatArray, covariance: FloatArray) -> float:
    """Return how unsure an outline is.

    Args:
        vertices: (V, 2) in m.
        covariance: (2 V, 2 V) of their coordinates.

    Returns:
        The median standard deviation (m) of the vertices across the outline.
    """
    along = np.roll(vertices, -1, axis=0) - np.roll(vertices, 1, axis=0)
    length = np.hypot(*along.T)
    across = np.column_stack((along[:, 1], -along[:, 0])) / np.where(length > 0, length, 1.0)[:, None]
    corner = np.arange(len(vertices))
    blocks = covariance.reshape(len(vertices), 2, len(vertices), 2)[corner, :, corner, :]
    variance = np.einsum("vi,vij,vj->v", across, blocks, across)
    return float(np.sqrt(np.median(np.maximum(variance, 0.0))))
