"""What the rays that meet candidates tell of the sensor: noise, footprint, dispersion."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from detect.refinement.candidates import Candidate
from detect.refinement.evidence import exact_costs
from detect.refinement.fit import TIES
from detect.refinement.kernels import MEASURED, PARAMETERS, RANGE, STOP, not_below, slopes, trace
from detect.refinement.rays import FAMILY, Beams, Sensor, in_table, parameters
from prim.arrays import FloatArray
from prim.shapes import Primitive

LEAST_START = 0.005
"""The first guess at the noise (m) is no smaller."""

LEAST_NOISE = 0.002
"""Noise (m) below this is not told apart: poses and ranges as logs hold them are no better."""

FEW = 20
"""Fewer rays than this do not tell the noise, and fewer scans no dispersion."""

FEW_OF_SCAN = 4
"""Fewer rays of one scan than this do not tell how far it is off as a whole."""

CLEARLY = 1.1
"""Scans are off as a whole where the squares of their mean errors are larger by such a factor."""

STRETCHES = (3, 10, 30)
FEW_STRETCHES = 6
"""How far scans are off together is asked of so many at once, where there are a few such stretches."""

LEAST_BLUR = 0.004
"""Silhouettes are blurred by this much (m) at least when it is asked which way they ought to move."""

CLEAR_ERROR = 4.0
"""A ray that is off by more standard deviations than this met something else."""

FOOTPRINTS = (0.0, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016)
"""Footprints (m) that are tried; the first two are taken for none."""

START_NOISE = 0.03
"""The noise (m) where nothing tells it."""


def first_noise(candidates: Sequence[Candidate]) -> float:
    """A first guess (m) of the noise: how far ranges are from where the starts would stop them, robustly."""
    residuals = np.concatenate([_residuals(one.beams, one.start) for one in candidates])
    if len(residuals) < 10:
        return START_NOISE
    return max(1.4826 * float(np.median(np.abs(residuals))), LEAST_START)


def _residuals(beams: Beams, primitive: Primitive) -> FloatArray:
    """How far (m) measured ranges are from a primitive that their rays meet."""
    distance = distance_to(primitive, beams)
    hit = (distance < beams.far) & (beams.kinds == MEASURED)
    return np.asarray(beams.rays[RANGE, hit] - distance[hit])


def measured(candidates: Sequence[Candidate], sensor: Sensor, noise_std: float | None) -> Sensor:
    """What the candidates' rays tell of the sensor: its noise where it is not given, footprint and dispersion."""
    std = noise_std or measured_noise(candidates, sensor)
    sensor = Sensor.of(std, sensor.span, sensor.footprint, most=sensor.most)
    footprint = measured_footprint(candidates, sensor)
    dispersion = measured_dispersion(candidates, sensor)
    if footprint > 0 or dispersion > CLEARLY:
        dispersion = max(dispersion, dispersion_over_time(candidates, replace(sensor, footprint=footprint)))
    return Sensor.of(std, sensor.span, footprint, dispersion, sensor.most)


def measured_footprint(candidates: Sequence[Candidate], sensor: Sensor) -> float:
    """The footprint (m) that makes the rays most likely which pass candidates' edges."""
    totals = np.zeros(len(FOOTPRINTS))
    for one in candidates:
        beams, fit = one.seen_before(candidates, sensor), one.fits[0]
        beams = beams.of(beams.passing(one.now, FOOTPRINTS[-1]) & ~beams.passing(one.now, -FOOTPRINTS[-1]))
        for k, footprint in enumerate(FOOTPRINTS):
            cost = exact_costs(fit.kind, fit.p[None], beams, replace(sensor, footprint=footprint))[0]
            totals[k] += cost if np.isfinite(cost) else 0.0  # larger than any primitive: it tells nothing
    return float(FOOTPRINTS[best]) if (best := int(np.argmin(totals))) > 1 else 0.0


def measured_dispersion(candidates: Sequence[Candidate], sensor: Sensor) -> float:
    """By how much the squared mean errors of scans' rays exceed what independent rays would make them; 1 at least."""
    squares, scans = 0.0, 0
    for one in candidates:
        beams = one.seen_before(candidates, sensor)
        distance = distance_to(one.now, beams)
        error = (beams.rays[RANGE] - distance) / sensor.std
        clear = (distance < beams.rays[STOP]) & (beams.kinds == MEASURED) & (np.abs(error) < CLEAR_ERROR)
        error = _without_cut(error, np.minimum((beams.far - sensor.span - distance) / sensor.std, 0.0))
        count = np.bincount(beams.scan[clear])
        total = np.bincount(beams.scan[clear], error[clear])
        many = count >= FEW_OF_SCAN
        squares += float((total[many] ** 2 / count[many]).sum())
        scans += int(np.count_nonzero(many))
    return max(squares / scans, 1.0) if scans >= FEW else 1.0


def dispersion_over_time(candidates: Sequence[Candidate], sensor: Sensor) -> float:
    """By how much what stretches of scans say of candidates differs more than independent rays would make it; or 1.

    Where poses are off for a while, what all rays of that while say is off together, of silhouettes too. For each
    stretch that is the slope of its rays' likelihood in the candidate's parameters; over all stretches these scatter
    as the information of the rays says (a sandwich, clustered by time; the longest stretch that tells more counts).
    """
    scores = [
        score
        for one in candidates
        if (score := _scores(one, one.seen_before(candidates, sensor), sensor)) is not None
    ]
    most = 1.0
    for length in STRETCHES:
        squares, freedom = 0.0, 0
        for score in scores:
            stretches = len(score) // length
            if stretches < FEW_STRETCHES:
                continue
            sums = score[: stretches * length].reshape(stretches, length, -1).sum(axis=1)
            sums -= sums.mean(axis=0)
            whole = len(score) / (stretches * length) * stretches**2 / (stretches - 1)
            squares += float((sums**2).sum()) * whole
            freedom += sums.size
        if freedom and (found := squares / freedom) > 1 + 3 * math.sqrt(2 / freedom):
            most = max(most, found)
    return most


def _scores(candidate: Candidate, beams: Beams, sensor: Sensor) -> FloatArray | None:
    """What each scan's rays say of a candidate's own parameters (S, K), in units that independent rays make 1 / S in
    the square; None where they say too little.
    """
    fit = candidate.fits[0]
    tie, blur = TIES[fit.kind], max(sensor.footprint, LEAST_BLUR)

    def told(some: Beams) -> tuple[FloatArray, FloatArray]:
        gradient, information = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
        shape = FAMILY[fit.kind], fit.p
        slopes(*shape, some.rays, some.kinds, sensor.std, sensor.table, blur, gradient, information)
        return tie.T @ gradient, tie.T @ information @ tie

    try:
        whiten = np.linalg.inv(np.linalg.cholesky(told(beams)[1]))
    except np.linalg.LinAlgError:
        return None
    scans, number = np.unique(beams.scan, return_inverse=True)
    return np.array([whiten @ told(beams.of(number == k))[0] for k in range(len(scans))])


def _without_cut(error: FloatArray, cut: FloatArray) -> FloatArray:
    """Errors (in standard deviations) of a normal distribution that ends at ``cut``, with mean 0 and variance 1."""
    tail = np.exp(-(cut**2) / 2) / math.sqrt(2 * math.pi) / not_below(cut)
    return np.asarray((error - tail) / np.sqrt(1 + cut * tail - tail**2))


def distance_to(primitive: Primitive, beams: Beams) -> FloatArray:
    """Where (m) beams meet a primitive; FAR where they do not."""
    distance = np.empty(len(beams))
    trace(FAMILY[primitive.kind], parameters(primitive), beams.rays, distance)
    return distance


def measured_noise(candidates: Sequence[Candidate], sensor: Sensor) -> float:
    """The noise (m) that makes the rays which meet candidates most likely, those that were cut off among them."""
    return noise_of([_met(one, one.seen_before(candidates, sensor)) for one in candidates], sensor)


def noise_of(met: Sequence[tuple[FloatArray, NDArray[np.int8], FloatArray]], sensor: Sensor) -> float:
    """The most likely noise (m) of rays that met something: distances, what was measured, ranges or their limits."""
    distance, kinds, z = (np.concatenate(part) for part in zip(*met, strict=True))
    count = int(np.count_nonzero(kinds == MEASURED))
    if count < FEW:
        return sensor.std

    def cost(log_std: float) -> float:
        std = math.exp(log_std)
        table = Sensor.of(std, sensor.span).table
        return count * log_std - float(in_table(table, kinds, (distance - z) / std).sum())

    return min(max(math.exp(_least(cost, math.log(sensor.std))), LEAST_NOISE), sensor.most)


def _met(candidate: Candidate, beams: Beams) -> tuple[FloatArray, NDArray[np.int8], FloatArray]:
    """Where (m) beams meet a candidate, what they measured (kind), and the range or its limit (m)."""
    distance = distance_to(candidate.now, beams)
    meets = (distance < beams.rays[STOP]) & (distance < beams.far)
    return distance[meets], beams.kinds[meets], beams.rays[RANGE, meets]


def _least(cost: Callable[[float], float], at: float, step: float = 0.5) -> float:
    """Where a function of one valley is least: stepped down to, then a parabola through three points, twice."""
    here = cost(at)
    for _ in range(12):
        left, right = cost(at - step), cost(at + step)
        if min(left, right) >= here:
            curve = left + right - 2 * here
            at += 0.5 * step * (left - right) / curve if curve > 0 else 0.0
            if step < 0.1:
                return at
            step, here = step / 6, cost(at)
        elif left < right:
            at, here = at - step, left
        else:
            at, here = at + step, right
    return at
