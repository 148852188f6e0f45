"""The likelihood of a beam: range noise, outliers, the sensor's footprint, and the background behind a shape.

A beam whose surface is at range r has the likelihood, in units of the Gaussian's peak 1 / (sigma sqrt(2 pi)):

- measured range z:  exp(-(z - r)² / 2 sigma²) + e
- too near (-inf):   Phi((range_min - r) / sigma) + e
- no return:         Phi((r - range_max) / sigma) + e

with e the outliers' uniform density in the same units: the beam model of Thrun, Burgard and Fox (2005, section 6.3)
without its exponential term, and with censored measurements (Tobit) in the place of its peak at range_max. Where the
share d of beams that meet a surface returns nothing (dropouts), the first terms are multiplied by 1 - d, and d is
added for a no return.

A beam whose line passes a shape hits it (r from the shape), or misses it and meets the background: another candidate
or a wall that occludes it (r from that), else the map. There the range is known to half a cell only, the map is wrong
for a share of the rays, and a beam that leaves the map returns from anywhere beyond, or not at all. At silhouettes
both likelihoods are mixed by the share of the beam's footprint that hits.

The forward mapper has a model of its own (mapping.forward.likelihood): there surfaces are unknown, and one share of
outliers for the whole log is estimated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from detect.refinement.likelihood.geometry import NUMBERS, OUTLINES, parameters_of
from detect.refinement.likelihood.kernels import (
    BACKGROUND,
    FAR,
    MEASURED,
    NO_RETURN,
    OCCLUSION,
    RANGE,
    TABLE_SPACING,
    TOO_NEAR,
    RayData,
    apply_occlusion,
    likelihood_table,
    occlude,
)
from detect.refinement.likelihood.rays import RayBundle, turned_rays
from detect.refinement.likelihood.traversal import cast_through_map
from detect.refinement.options import DEFAULTS, SensorOptions
from mapping.grid import GridFrame
from mapping.morphology import chessboard_distances
from prim.arrays import FloatArray
from prim.shapes import Primitive


@dataclass(frozen=True)
class BeamModel:
    """What is known of the sensor.

    Attributes:
        std: Range noise (m).
        span: range_max - range_min (m).
        table: Log-likelihoods (6, T) of :func:`detect.refinement.likelihood.kernels.likelihood_table`.
        footprint: Half the width (m) over which a beam that passes an edge may meet it or not: the beam's own width
            and the errors of poses and bearings.
        dispersion: The factor by which squared errors of whole scans exceed those of independent rays; 1 where poses
            are exact.
        max_std: Upper bound of the noise (m).
        options: The model's numbers.
        dropout_share: Share of beams that meet a surface and return nothing.
    """

    std: float
    span: float
    table: FloatArray
    footprint: float = 0.0
    dispersion: float = 1.0
    max_std: float = math.inf
    options: SensorOptions = DEFAULTS.sensor
    dropout_share: float = 0.0

    @classmethod
    def create(
        cls,
        std: float,
        span: float,
        footprint: float = 0.0,
        dispersion: float = 1.0,
        max_std: float = math.inf,
        options: SensorOptions = DEFAULTS.sensor,
        dropout_share: float = 0.0,
    ) -> BeamModel:
        """Make a model with the table that follows from noise, span and dropouts.

        Args:
            std: Range noise (m).
            span: range_max - range_min (m).
            footprint: Half-width (m).
            dispersion: 1 or more.
            max_std: Upper bound of the noise (m).
            options: The model's numbers.
            dropout_share: Share of beams that meet a surface and return nothing.

        Returns:
            The model.
        """
        table = likelihood_table(options.outlier_share * _uniform_density(std, span), dropout_share)
        return cls(std, span, table, footprint, dispersion, max_std, options, dropout_share)

    def data(self, bundle: RayBundle) -> RayData:
        """Return a bundle's rays as the kernels take them."""
        return RayData(bundle.rays, bundle.outcomes, self.std, self.table)


def _inverse_peak(std: float) -> float:
    """Return one over the Gaussian's peak (m): a density of 1 / m in units of it."""
    return std * math.sqrt(2 * math.pi)


def _uniform_density(std: float, span: float) -> float:
    """Return the uniform density over all ranges in units of the Gaussian's peak."""
    return _inverse_peak(std) / span


@dataclass(frozen=True)
class Background:
    """What rays meet in the map where they miss a primitive.

    Attributes:
        ranges: (N,) where they end (m).
        hits_map: (N,) whether that is an occupied cell; the others leave the map there.
        blocked: (N,) whether they end before they come near the primitive.
        uncertainty: (N,) standard deviations of the ranges (m).
    """

    ranges: FloatArray
    hits_map: NDArray[np.bool_]
    blocked: NDArray[np.bool_]
    uncertainty: FloatArray

    def select(self, chosen: NDArray[np.bool_]) -> Background:
        """Return the background of the chosen rays (N,)."""
        return Background(self.ranges[chosen], self.hits_map[chosen], self.blocked[chosen], self.uncertainty[chosen])

    def nearer_by(self, distance: float) -> Background:
        """Return the background with all ranges shorter by a distance (m)."""
        return replace(self, ranges=self.ranges - distance) if distance else self


@dataclass(frozen=True)
class DistanceMap:
    """The chessboard distance (cells) of each cell (rows, cols) of a map to the nearest occupied one."""

    distances: NDArray[np.uint8]
    frame: GridFrame

    @classmethod
    def of(cls, occupied: NDArray[np.bool_], frame: GridFrame) -> DistanceMap:
        """Compute the distances.

        Args:
            occupied: (rows, cols) the map's occupied cells.
            frame: Where they lie.

        Returns:
            The map of distances.
        """
        return cls(chessboard_distances(occupied), frame)

    def background(self, bundle: RayBundle) -> Background:
        """Cast rays through the map; a cell says where its surface is to within a cell."""
        ranges, hits_map = np.zeros(len(bundle)), np.zeros(len(bundle), np.bool_)
        frame = self.frame
        grid = frame.row, frame.col, 1 / frame.resolution
        cast_through_map(self.distances, grid, bundle.rays, bundle.max_range, ranges, hits_map)
        uncertainty = np.full(len(bundle), 0.5 * frame.resolution)
        return Background(ranges, hits_map, hits_map & (ranges < bundle.entry_range), uncertainty)


def background_log_likelihood(bundle: RayBundle, background: Background, sensor: BeamModel) -> FloatArray:
    """Compute the log-likelihood of measurements by the background.

    Args:
        bundle: N rays.
        background: What they meet.
        sensor: The sensor.

    Returns:
        (N,) in nats.
    """
    likelihood = surface_likelihood(bundle, background.ranges, background.hits_map, background.uncertainty, sensor)
    return np.asarray(np.log(likelihood))


def occlusion_by(bundle: RayBundle, occluders: Sequence[Primitive], reach: float = 0.0) -> FloatArray:
    """Compute where beams meet the first of some things that may stand before a primitive or the background.

    Args:
        bundle: N rays.
        occluders: Other primitives and walls.
        reach: Angle (rad) on both sides of a beam's axis within which the nearest surface is met.

    Returns:
        (N,) ranges in m; FAR where a beam meets none.
    """
    nearest = np.full(len(bundle), FAR)
    turns = () if not occluders else (-reach, 0.0, reach) if reach else (0.0,)
    for turn in turns:
        rays = turned_rays(bundle.rays, turn)
        rays[OCCLUSION] = FAR
        for other in occluders:
            occlude(OUTLINES, NUMBERS[other.kind], parameters_of(other), other.bounding_radius, rays)
        nearest = np.minimum(nearest, rays[OCCLUSION])
    return nearest


def with_background(
    bundle: RayBundle,
    background: Background,
    log_likelihood: FloatArray,
    occlusion: FloatArray,
    sensor: BeamModel,
) -> RayBundle:
    """Return rays with what they measure where they miss a primitive.

    Args:
        bundle: N rays.
        background: What they meet in the map.
        log_likelihood: (N,) of :func:`background_log_likelihood`.
        occlusion: (N,) of :func:`occlusion_by`.
        sensor: The sensor.

    Returns:
        The rays, the rows OCCLUSION and BACKGROUND set.
    """
    rays = bundle.rays.copy()
    rays[OCCLUSION], rays[BACKGROUND] = occlusion, log_likelihood
    apply_occlusion(RayData(rays, bundle.outcomes, sensor.std, sensor.table), background.ranges, background.blocked)
    return bundle.with_rays(rays)


def table_nearest(table: FloatArray, outcomes: NDArray[np.int8], x: FloatArray) -> FloatArray:
    """Look up log-likelihoods without interpolation.

    Args:
        table: Of :func:`detect.refinement.likelihood.kernels.likelihood_table`.
        outcomes: (N,) rows.
        x: (N,) residuals in standard deviations.

    Returns:
        (N,) the entries nearest to x.
    """
    reach = (table.shape[1] - 1) / 2
    place = np.clip(np.rint(x * TABLE_SPACING + reach), 0, 2 * reach).astype(np.intp)
    return np.asarray(table[outcomes, place])


def surface_likelihood(
    bundle: RayBundle, ranges: FloatArray, hits_map: NDArray[np.bool_], uncertainty: FloatArray, sensor: BeamModel
) -> FloatArray:
    """Compute the likelihood of measurements where rays end at given ranges, or leave the map there.

    A ray that leaves the map ends anywhere beyond, or nowhere.

    Args:
        bundle: N rays.
        ranges: (N,) where they end or leave (m).
        hits_map: (N,) whether they end.
        uncertainty: (N,) standard deviations of these ranges (m).
        sensor: The sensor.

    Returns:
        (N,) in units of the Gaussian's peak for measured ranges.
    """
    z, outcomes, options = bundle.rays[RANGE], bundle.outcomes, sensor.options
    uniform = _uniform_density(sensor.std, sensor.span)
    wide = np.hypot(sensor.std, uncertainty)
    at_surface = np.exp(table_nearest(sensor.table, outcomes, (ranges - z) / wide))
    at_surface *= np.where(outcomes == MEASURED, sensor.std / wide, 1.0)
    behind = np.full(len(z), TOO_NEAR, np.int8)
    beyond = np.exp(table_nearest(sensor.table, behind, (ranges - z) / sensor.std))  # (1 - d) Phi((z - r) / sigma)
    nothing = options.no_return_beyond + (1 - options.no_return_beyond) * sensor.dropout_share
    left = np.where(
        outcomes == MEASURED,
        (1 - options.no_return_beyond)
        * beyond
        * _inverse_peak(sensor.std)
        / np.maximum(bundle.max_range - ranges, sensor.std),
        np.where(outcomes == NO_RETURN, nothing, options.outlier_share),
    )
    unexplained = np.where(outcomes == MEASURED, uniform, options.censored_doubt)
    doubt = options.background_doubt
    return np.asarray((1 - doubt) * np.where(hits_map, at_surface, left) + doubt * unexplained)
