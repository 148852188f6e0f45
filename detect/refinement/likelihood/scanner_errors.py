"""Errors that all beams of a scanner have in common: a bias of ranges, beams of a width, and mixed pixels.

A beam of some width may read the nearest surface within it: then it meets edges that its axis passes at a distance,
and surfaces seen at a slant look nearer. What is measured is the range along the nearest of all directions within
:attr:`ScannerErrors.reach` of the beam's axis. Which direction that is follows from the shape as it was last fitted;
rays are turned to it, and the likelihood stays as it is.

A beam that meets two surfaces may also read a range between both (a mixed pixel). Where a silhouette lies within such
a beam, that reading says neither hit nor miss, and is left out.

A bias of ranges has moved the surfaces of the map, too, which was made of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from detect.refinement.likelihood.geometry import NUMBERS, OUTLINES, parameters_of, ranges_to
from detect.refinement.likelihood.kernels import (
    BACKGROUND,
    DIRECTION_X,
    DIRECTION_Y,
    FAR,
    MEASURED,
    OCCLUSION,
    RANGE,
    RayData,
    apply_occlusion,
    cast_rays,
    silhouette_clearances,
)
from detect.refinement.likelihood.rays import RayBundle, turned_rays
from detect.refinement.likelihood.sensor_model import Background, BeamModel
from prim.arrays import FloatArray
from prim.shapes import Primitive


@dataclass(frozen=True)
class ScannerErrors:
    """What all beams of a scanner have in common.

    Attributes:
        range_bias: Measured less true range (m).
        reach: Angle (rad) on both sides of a beam's axis within which the nearest surface is read; 0 for beams
            without a width.
        mixed: Angle (rad) on both sides of the axis within which two surfaces give a range between both; 0 where
            they do not.
    """

    range_bias: float = 0.0
    reach: float = 0.0
    mixed: float = 0.0


NO_ERRORS = ScannerErrors()


@dataclass(frozen=True)
class Surroundings:
    """What rays may meet beside a candidate.

    Attributes:
        background: What they meet in the map.
        log_likelihood: (N,) of the measurements by it (nats).
        walls: Ranges (N,) in m to the map's walls, of :func:`detect.refinement.likelihood.sensor_model.occlusion_by`.
        others: Ranges (N,) in m to further things, such as other candidates.
    """

    background: Background
    log_likelihood: FloatArray
    walls: FloatArray
    others: FloatArray


def without_errors(
    bundle: RayBundle, around: Surroundings, shape: Primitive, sensor: BeamModel, errors: ScannerErrors
) -> RayBundle:
    """Return rays as a scanner without errors would have measured them, with what they measure where they miss.

    Args:
        bundle: N rays as they were measured.
        around: What else they may meet, by beams of the width that ``errors`` has.
        shape: The primitive as it was last fitted.
        sensor: The sensor.
        errors: The scanner's errors.

    Returns:
        The rays: ranges and limits without the bias, directions turned to the nearest surface, the rows OCCLUSION and
        BACKGROUND set. Mixed pixels are occluded: they have no part in the likelihood.
    """
    rays = bundle.rays.copy()
    rays[RANGE] -= errors.range_bias
    rays[BACKGROUND] = around.log_likelihood
    rays[OCCLUSION] = np.minimum(around.walls - errors.range_bias, around.others)
    behind = around.background.ranges - errors.range_bias
    apply_occlusion(RayData(rays, bundle.outcomes, sensor.std, sensor.table), behind, around.background.blocked)
    if errors.mixed:
        mixed = silhouette_readings(bundle.with_rays(rays), shape, (errors.mixed,), sensor)[1][0]
        rays[OCCLUSION, mixed] = 0.0
    if errors.reach:
        _turn_to_nearest(rays, shape, [share * errors.reach for share in sensor.options.beam_parts])
    return bundle.with_rays(rays)


def _turn_to_nearest(rays: FloatArray, shape: Primitive, turns: Sequence[float]) -> None:
    """Turn rays (7, N) to where a shape is nearest, by one of some angles (rad).

    Near a silhouette they are turned towards the shape, so that they hit it as long as any part of the beam does;
    the measured range is raised by what the shape is further away there than where it is nearest.
    """
    number, p, every = NUMBERS[shape.kind], parameters_of(shape), np.arange(rays.shape[1])
    turned = [turned_rays(rays, turn) for turn in turns]
    ranges, clearances = np.empty((2, len(turned), rays.shape[1]))
    for one, away, aside in zip(turned, ranges, clearances, strict=True):
        cast_rays(OUTLINES, number, p, one, away)
        silhouette_clearances(OUTLINES, number, p, one, aside)
    least, most = clearances.min(axis=0), clearances.max(axis=0)
    chosen = np.where(least < most - least, clearances.argmax(axis=0), ranges.argmin(axis=0))
    at, nearest = ranges[chosen, every], ranges.min(axis=0)
    rays[RANGE] += np.where(at < FAR, at - nearest, 0.0)
    directions = np.stack([one[DIRECTION_X : DIRECTION_Y + 1] for one in turned])
    rays[DIRECTION_X : DIRECTION_Y + 1] = directions[chosen, :, every].T


def silhouette_readings(
    bundle: RayBundle, shape: Primitive, angles: Sequence[float], sensor: BeamModel
) -> tuple[list[NDArray[np.bool_]], list[NDArray[np.bool_]]]:
    """Find the rays whose beam, of some width, holds a shape's silhouette, and those that read what is between.

    Args:
        bundle: N rays with their background.
        shape: The primitive.
        angles: Half-widths (rad).
        sensor: The sensor.

    Returns:
        For each half-width which rays (N,) hold the silhouette; and which of them measured a range beyond the shape
        that neither it nor the background explains.
    """
    limits, rays = sensor.options, bundle.rays
    holds, between = [], []
    for angle in angles:
        sides = [ranges_to(shape, turned_rays(rays, turn)) for turn in (-angle, 0.0, angle)]
        near = np.minimum.reduce(sides)
        held = (near < FAR) & (np.maximum(sides[0], sides[2]) == FAR) & (near < rays[OCCLUSION])
        held &= bundle.outcomes == MEASURED
        beyond = rays[RANGE] > near + limits.beyond * sensor.std
        holds.append(held)
        between.append(held & beyond & (rays[BACKGROUND] < limits.unexplained))
    return holds, between
