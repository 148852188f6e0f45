"""Error bars of fits to scans between which a primitive was moved.

A fit to scans that show a primitive in several places lies between these, far more precisely than it is right. Its
later scans alone tell: where they are likelier with the primitive elsewhere nearby, the distance to there is an error
that the covariance lacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from detect.detection import Detection, SensorErrors
from detect.refinement.options import StandingOptions
from detect.refinement.standing import Verdict, judge_places
from detect.refinement.surroundings.levels import MapLevels
from prim.arrays import FloatArray
from prim.scan import Scan
from prim.se2 import Pose2D, angle_difference
from prim.shapes import Primitive
from prim.threads import cores


@dataclass(frozen=True)
class MixedOptions:
    """When the later scans of a fit disagree with it; chosen on 12 sessions with pushed primitives.

    Attributes:
        min_gain: nats; their rays are likelier by more with the primitive elsewhere …
        min_displacement: m; … displaced by more than this.
        max_displacement: Share of its circumscribed radius; further away they are taken to show something else.
        min_scans: Fewer pieces of scans are not judged alone.
    """

    min_gain: float = 20.0
    min_displacement: float = 0.002
    max_displacement: float = 1.0
    min_scans: int = 4


DEFAULTS = MixedOptions()


def add_disagreement(
    detection: Detection,
    scans: Sequence[tuple[Scan, Pose2D]],
    levels: MapLevels,
    noise_std: float,
    slack: float = 0.0,
    options: MixedOptions = DEFAULTS,
    sensor_errors: SensorErrors | None = None,
) -> Detection:
    """Add to a fit's covariance how far its later scans disagree with it: the last half, the last quarter and so on.

    Args:
        detection: The refined primitive.
        scans: The pieces of scans, in the order of time; those since ``detection.since`` count.
        levels: The map that shows what is behind the primitive.
        noise_std: Range noise (m).
        slack: What the poses' errors alone may displace it by (m).
        options: Those of the judgement.
        sensor_errors: Errors of the scanner that were corrected where it was fitted.

    Returns:
        The detection with the larger covariance; the same one where they agree.
    """
    if detection.covariance is None:
        return detection
    part = [piece for piece in scans if detection.since is None or piece[0].stamp >= detection.since]
    reach = options.max_displacement * detection.primitive.bounding_radius
    limits = StandingOptions(min_gain=options.min_gain, min_displacement=options.min_displacement)
    displacements = []
    while len(part) // 2 >= options.min_scans:
        part = part[len(part) // 2 :]
        (judgement,) = judge_places([detection], part, levels, noise_std, cores(), slack, limits, sensor_errors)
        displacement = _displacement(detection.primitive, judgement.nearby)
        if judgement.verdict is Verdict.MOVED and _length(displacement) < reach:
            displacements.append(displacement)
    return _widened(detection, detection.covariance, max(displacements, key=_length)) if displacements else detection


def _length(displacement: FloatArray) -> float:
    """Return how far (m) the place is displaced."""
    return float(np.hypot(displacement[0], displacement[1]))


def _displacement(before: Primitive, after: Primitive) -> FloatArray:
    """Return the differences (K,) of the parameters (m, rad) of two primitives of one kind."""
    turn = []
    if before.theta is not None and after.theta is not None:
        period = before.symmetry
        turn = [0.0 if period is None else angle_difference(after.theta, before.theta, period)]
    sizes = np.subtract(after.size, before.size)
    return np.array([after.x - before.x, after.y - before.y, *turn, *sizes])


def _widened(detection: Detection, covariance: FloatArray, displacement: FloatArray) -> Detection:
    """Return a detection with a displacement (K,) of the parameters as a further error, in any direction."""
    added = np.square(displacement)
    added[:2] = added[:2].sum()
    covariance = covariance + np.diag(added)
    names = detection.primitive.kind.parameters
    std = dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    return replace(detection, std=std, covariance=covariance)
