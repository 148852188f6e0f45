"""Faults that real scanners have: a range bias, wide beams, quantised ranges, dropouts, outliers, noise that grows.

A beam of some width lights several surfaces at an edge. It is cast as sub-rays with Gaussian weights: the light of
each comes back from where it ends. Light from nearly the same distance makes one echo, at its weighted mean distance;
light from surfaces farther apart makes several. A scanner reports one of them, by chance the nearest one or the
strongest one, or, where it does not separate them, a distance between: a mixed pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from prim.arrays import FloatArray


@dataclass(frozen=True)
class ScannerFaults:
    """How a scanner differs from one with rays for beams and white noise.

    A range is measured in this order: the beam's echo (``beam_width``), plus ``range_bias``, plus noise (the LiDAR's
    own and ``noise_growth``), or an outlier in its place, rounded to ``quantum``, limited as by REP 117, dropped out.

    Attributes:
        range_bias: What is added to each range (m).
        beam_width: Full angular width of a beam (rad), over which its weights are those of a Gaussian whose standard
            deviation is a quarter of it (a laser's width at 1/e^2 of the intensity).
        quantum: Ranges are rounded to whole multiples of this (m); 0: not at all.
        dropouts: The share of beams that return nothing, whatever they meet.
        dropout_as: What is written for them: a key of :data:`DROPOUT_VALUES`.
        outliers: The share of beams whose range is uniform between the scanner's limits.
        noise_growth: Standard deviation of a further noise per metre of distance (m/m): variances add up.
    """

    range_bias: float = 0.0
    beam_width: float = 0.0
    quantum: float = 0.0
    dropouts: float = 0.0
    dropout_as: str = "inf"
    outliers: float = 0.0
    noise_growth: float = 0.0


NO_FAULTS = ScannerFaults()

LONGEST = "max"

DROPOUT_VALUES: Mapping[str, float | None] = {"nan": np.nan, "0": 0.0, "inf": np.inf, LONGEST: None}
"""What may be written for a beam that dropped out, by name; None: the scanner's longest range."""


@dataclass(frozen=True)
class BeamOptions:
    """How a beam of some width is simulated; all set by hand.

    Attributes:
        sub_rays: Rays that stand for it.
        separation: Light from distances that differ by no more than this from the next ones makes one echo (m); about
            the length of a pulse of 1 ns.
        detectable: An echo of a smaller share of the beam's light is not detected.
        nearest: How often the nearest echo is reported.
        strongest: How often the strongest one; else the mean of all, weighted by their light.
    """

    sub_rays: int = 21
    separation: float = 0.15
    detectable: float = 0.1
    nearest: float = 0.4
    strongest: float = 0.4


BEAM = BeamOptions()


@dataclass(frozen=True)
class FaultGenerators:
    """A random generator for each cause of chance among the faults.

    Attributes:
        beam: Draws which echo is reported.
        outliers: Draws which beams have an outlier, and its range.
        dropouts: Draws which beams drop out.
    """

    beam: np.random.Generator
    outliers: np.random.Generator
    dropouts: np.random.Generator

    @classmethod
    def spawned_from(cls, rng: np.random.Generator) -> FaultGenerators:
        """Make children of a generator, which goes on as before."""
        return cls(*rng.spawn(3))


def sub_ray_offsets(width: float, options: BeamOptions = BEAM) -> FloatArray:
    """Return the bearings (K,) of a beam's sub-rays relative to its own (rad).

    Args:
        width: The beam's full width (rad).
        options: How many there are.

    Returns:
        The middles of equal parts of the width.
    """
    return np.asarray(((np.arange(options.sub_rays) + 0.5) / options.sub_rays - 0.5) * width)


def reported_echoes(distances: FloatArray, draws: FloatArray, options: BeamOptions = BEAM) -> FloatArray:
    """Compute what distances beams of some width report, without noise.

    Args:
        distances: (N, K) along the sub-rays of each beam (m); inf where there is no surface.
        draws: (N,) uniform from 0 to 1: which echo is reported.
        options: How echoes arise.

    Returns:
        Distances (N,) in m; inf where no echo is detected.
    """
    energies, means = _echoes(np.asarray(distances), options)
    detected = energies >= options.detectable
    nearest = np.where(detected, means, np.inf).min(axis=1)
    strongest = np.take_along_axis(means, energies.argmax(axis=1)[:, None], axis=1)[:, 0]
    light = np.where(detected, energies, 0.0)
    with np.errstate(invalid="ignore"):  # beams without an echo
        mixed = (light * means).sum(axis=1) / light.sum(axis=1)
    reported = np.select(
        (draws < options.nearest, draws < options.nearest + options.strongest), (nearest, strongest), mixed
    )
    return np.asarray(np.where(detected.any(axis=1), reported, np.inf))


def _echoes(distances: FloatArray, options: BeamOptions) -> tuple[FloatArray, FloatArray]:
    """Return the shares of the beam's light in its echoes (N, K), and their distances (m); 0 where there is none."""
    weights = np.exp(-0.5 * (4 * sub_ray_offsets(1.0, options)) ** 2)
    order = np.argsort(distances, axis=1)
    ordered = np.take_along_axis(distances, order, axis=1)
    light = np.where(np.isfinite(ordered), (weights / weights.sum())[order], 0.0)
    ordered = np.where(np.isfinite(ordered), ordered, 0.0)
    starts = np.diff(ordered, axis=1, prepend=ordered[:, :1]) > options.separation
    echo = np.cumsum(starts, axis=1)
    rows = np.broadcast_to(np.arange(len(distances))[:, None], echo.shape)
    energies, sums = np.zeros(echo.shape), np.zeros(echo.shape)
    np.add.at(energies, (rows, echo), light)
    np.add.at(sums, (rows, echo), light * ordered)
    return energies, np.divide(sums, energies, out=np.zeros_like(sums), where=energies > 0)


def with_outliers(
    ranges: FloatArray, share: float, limits: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Put uniform ranges in the place of some.

    Args:
        ranges: (N,) in m.
        share: How many, on average.
        limits: The smallest and the largest one (m).
        rng: Draws which, and their ranges.

    Returns:
        Ranges (N,) in m.
    """
    are_out, values = rng.random(len(ranges)) < share, rng.uniform(*limits, len(ranges))
    return np.where(are_out, values, ranges)


def with_dropouts(ranges: FloatArray, share: float, value: float, rng: np.random.Generator) -> FloatArray:
    """Put a value in the place of some ranges.

    Args:
        ranges: (N,) in m.
        share: How many, on average.
        value: What a scanner writes where nothing returned.
        rng: Draws which.

    Returns:
        Ranges (N,) in m.
    """
    return np.where(rng.random(len(ranges)) < share, value, ranges)
