"""Whether primitives stand, in some scans, where they were fitted by others.

A fit to the rays of all scans mixes the places of a primitive that moved. Some of the scans alone, the recent ones,
tell: either their rays are likelier without the primitive anywhere near (it is gone), or with it elsewhere nearby
(it was moved).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum

import numpy as np

from detect.detection import Detection, SensorErrors
from detect.refinement.candidates import Candidate, find_backgrounds
from detect.refinement.fitting.evidence import exact_costs
from detect.refinement.fitting.fit import refit_same_kind
from detect.refinement.likelihood.geometry import parameters_of, primitive_of
from detect.refinement.likelihood.kernels import BACKGROUND
from detect.refinement.likelihood.rays import collect_rays
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import DEFAULTS, StandingOptions
from detect.refinement.scanner_errors import errors_of
from detect.refinement.sensor_estimation import estimate_dropouts
from detect.refinement.surroundings.levels import MapLevels
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Primitive, angle_error


class Verdict(Enum):
    """What the rays of some scans say of a primitive's place."""

    STANDS = "stands"
    MOVED = "moved"
    GONE = "gone"


@dataclass(frozen=True)
class Judgement:
    """What the rays of some scans say of a primitive's place.

    Attributes:
        verdict: Whether it stands there.
        nearby: The primitive at the likeliest place nearby.
        log_ratio: Log-likelihood ratio of the rays with the primitive against nothing in its place (nats).
    """

    verdict: Verdict
    nearby: Primitive
    log_ratio: float = 0.0

    @property
    def is_seen(self) -> bool:
        """Whether the rays show that it stands, not merely nothing else."""
        return self.verdict is Verdict.STANDS and self.log_ratio > 0


def judge_places(
    detections: Sequence[Detection],
    scans: Iterable[tuple[Scan, Pose2D]],
    levels: MapLevels,
    noise_std: float,
    threads: int,
    slack: float = 0.0,
    limits: StandingOptions = DEFAULTS.standing,
    sensor_errors: SensorErrors | None = None,
) -> list[Judgement]:
    """Judge whether primitives stand, in some scans, where they were fitted.

    Args:
        detections: The fitted primitives.
        scans: The scans, with the laser's poses.
        levels: The map that shows what is behind the primitives.
        noise_std: Range noise (m).
        threads: How many are used.
        slack: What the poses' errors alone may displace a primitive by (m).
        limits: When a primitive is gone, or was moved.
        sensor_errors: Errors of the scanner that were corrected where they were fitted.

    Returns:
        The judgement of each; it stands also where no ray says otherwise.
    """
    if not detections:
        return []
    primitives = [detection.primitive for detection in detections]
    options, errors = levels.options, errors_of(sensor_errors)
    shown = [levels.showing(primitive) for primitive in primitives]
    reaches = [level.options.rays.fitted_reach for level in shown]
    bundles, span, max_noise = collect_rays(scans, primitives, reaches, options)
    candidates = [
        Candidate(detection.primitive, bundle, level.cells, detection, level.options, errors=errors)
        for detection, bundle, level in zip(detections, bundles, shown, strict=True)
    ]
    with ThreadPoolExecutor(threads) as pool:
        find_backgrounds(pool, candidates)
        dropouts = estimate_dropouts(candidates, noise_std, options.sensor)
        sensor = BeamModel.create(noise_std, span or 1.0, 0.0, 1.0, max_noise, options.sensor, dropouts)
        return list(pool.map(lambda candidate: _judge(candidate, candidates, sensor, slack, limits), candidates))


def _judge(
    candidate: Candidate, candidates: Sequence[Candidate], sensor: BeamModel, slack: float, limits: StandingOptions
) -> Judgement:
    """Judge one primitive beside the others."""
    start = candidate.start
    if not len(candidate.bundle):
        return Judgement(Verdict.STANDS, start)
    kind, p = start.kind, parameters_of(start)
    bundle = candidate.rays_with_background(candidates, sensor)
    (fit,) = refit_same_kind(candidate.known_fit, bundle, sensor, candidate.options.fit)
    here, there = exact_costs(kind, np.stack([p, fit.p]), bundle, sensor, candidate.options.evidence).tolist()
    nearby, nothing = primitive_of(kind, fit.p), float(-bundle.rays[BACKGROUND].sum())
    if min(here, there) - nothing > limits.min_nats_against:
        return Judgement(Verdict.GONE, start, nothing - here)
    if here - there > limits.min_gain and _is_displaced(start, nearby, slack, limits):
        return Judgement(Verdict.MOVED, nearby, nothing - here)
    return Judgement(Verdict.STANDS, start, nothing - here)


def _is_displaced(before: Primitive, after: Primitive, slack: float, limits: StandingOptions) -> bool:
    """Return whether a primitive's outline was displaced, shifted or turned, by more than errors explain."""
    shift = math.hypot(after.x - before.x, after.y - before.y)
    turn = angle_error(after, before) or 0.0
    return max(shift, turn * before.bounding_radius) > max(limits.min_displacement, slack)
