"""Straight walls measured by rays: a map's cells say where a wall is to within a cell, its rays to millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from detect.refinement.likelihood.kernels import (
    DIRECTION_X,
    DIRECTION_Y,
    MEASURED,
    ORIGIN_X,
    ORIGIN_Y,
    RANGE,
)
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import Background
from detect.refinement.options import DEFAULTS, SurfaceOptions
from detect.refinement.surroundings.map_cells import OneSidedWall
from prim import linear_algebra
from prim.arrays import FloatArray
from prim.normal import NORMAL_MAD


def measure_walls(
    walls: Sequence[OneSidedWall],
    rays: Sequence[tuple[RayBundle, Background]],
    resolution: float,
    options: SurfaceOptions = DEFAULTS.surfaces,
) -> list[OneSidedWall]:
    """Fit the lines of walls to the rays that meet them.

    Args:
        walls: The walls as the map's cells show them.
        rays: Rays, with what they meet in the map; those that meet candidates left out.
        resolution: The map's (m).
        options: Numeric parameters.

    Returns:
        The walls that enough rays meet, with the lines that these say.
    """
    found = (_measured(wall, rays, resolution, options) for wall in walls)
    return [wall for wall in found if wall is not None]


def sharpen(
    background: Background,
    bundle: RayBundle,
    walls: Sequence[OneSidedWall],
    resolution: float,
    options: SurfaceOptions = DEFAULTS.surfaces,
) -> Background:
    """Let rays that meet a wall's cells end at its line.

    Args:
        background: What the rays meet in the map.
        bundle: The rays.
        walls: Measured walls.
        resolution: The map's (m).
        options: Numeric parameters.

    Returns:
        The background.
    """
    ranges, uncertainty = background.ranges.copy(), background.uncertainty.copy()
    for wall in walls:
        crossing, _ = _crossings(wall, bundle)
        on_it = _meets(wall, bundle, background, resolution, options)
        ranges[on_it], uncertainty[on_it] = crossing[on_it], options.uncertainty
    return replace(background, ranges=ranges, uncertainty=uncertainty)


def _crossings(wall: OneSidedWall, bundle: RayBundle) -> tuple[FloatArray, FloatArray]:
    """Return the ranges (N,) at which rays cross a wall's line, and the cosines of their incidence (N,)."""
    nx, ny, d = wall.line
    rays = bundle.rays
    incidence = -(nx * rays[DIRECTION_X] + ny * rays[DIRECTION_Y])
    height = nx * rays[ORIGIN_X] + ny * rays[ORIGIN_Y] - d
    return height / np.where(np.abs(incidence) > 0, incidence, np.inf), incidence


def _along(wall: OneSidedWall, bundle: RayBundle, ranges: FloatArray) -> FloatArray:
    """Return where along a wall's line (m) the points of rays at these ranges lie."""
    nx, ny, _ = wall.line
    rays = bundle.rays
    x, y = rays[ORIGIN_X] + ranges * rays[DIRECTION_X], rays[ORIGIN_Y] + ranges * rays[DIRECTION_Y]
    return np.asarray(nx * y - ny * x)


def _meets(
    wall: OneSidedWall, bundle: RayBundle, background: Background, resolution: float, options: SurfaceOptions
) -> NDArray[np.bool_]:
    """Tell which rays (N,) end in cells at a wall's line, and not too obliquely."""
    crossing, incidence = _crossings(wall, bundle)
    meets = background.hits_map & ~background.blocked & (incidence > options.min_incidence) & (crossing > 0)
    meets &= np.abs(crossing - background.ranges) * incidence < options.width * resolution
    along = _along(wall, bundle, crossing)
    return np.asarray(meets & (along > wall.first) & (along < wall.last))


def _measured(
    wall: OneSidedWall,
    rays: Sequence[tuple[RayBundle, Background]],
    resolution: float,
    options: SurfaceOptions,
) -> OneSidedWall | None:
    """Return a wall with the line that its rays say; None where these are too few."""
    places, offsets, cosines = [], [], []
    for bundle, background in rays:
        crossing, incidence = _crossings(wall, bundle)
        chosen = _meets(wall, bundle, background, resolution, options) & (bundle.outcomes == MEASURED)
        places.append(_along(wall, bundle, crossing)[chosen])
        offsets.append(((bundle.rays[RANGE] - crossing) * incidence)[chosen])
        cosines.append(incidence[chosen])
    place, offset, cosine = (np.concatenate(part) for part in (places, offsets, cosines))
    if len(place) < options.min_rays:
        return None
    middle, shift, slope = _robust_line(place, offset, cosine, options)
    nx, ny, d = wall.line
    length = float(np.hypot(1.0, slope))
    line = ((nx - slope * ny) / length, (ny + slope * nx) / length, (d - shift + slope * middle) / length)
    return replace(wall, line=line)


def _robust_line(
    place: FloatArray, offset: FloatArray, cosine: FloatArray, options: SurfaceOptions
) -> tuple[float, float, float]:
    """Fit offset = shift + slope (place - middle) by iteratively reweighted least squares (Huber 1964)."""
    middle = float(place.mean())
    design = np.column_stack((np.ones(len(place)), place - middle))
    fit = np.array([float(np.median(offset)), 0.0])
    for _ in range(options.iterations):
        residual = (offset - design @ fit) / cosine
        scale = max(NORMAL_MAD * float(np.median(np.abs(residual))), options.uncertainty)
        weight = (
            np.minimum(1.0, options.huber * scale / np.maximum(np.abs(residual), options.uncertainty)) / cosine**2
        )
        weighted = design * weight[:, None]
        normal = weighted.T @ design + np.diag([0.0, options.slope_precision])
        better = linear_algebra.solve(normal, weighted.T @ offset)
        fit = fit if better is None else better
    return middle, float(fit[0]), float(fit[1])
