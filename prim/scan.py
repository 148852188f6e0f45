"""One scan of a 2D LiDAR: what its ranges mean, and how it is cut where the laser moved while it was taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import Pose2D, wrap_angle


class RangeOutcome(IntEnum):
    """The outcome of one beam, nearly as REP 117 and sensor_msgs/LaserScan define it; the differences stand below.

    ============  =======================================  ====================================================
    outcome       range z                                  meaning
    ============  =======================================  ====================================================
    MEASURED      range_min <= z < range_max, and z > 0    the distance to a surface
    TOO_NEAR      -inf                                     a surface nearer than range_min
    NO_RETURN     z >= range_max, +inf among them          no surface up to range_max
    INVALID       NaN; finite, but below range_min or <= 0  no measurement
    ============  =======================================  ====================================================

    REP 117 («Informational Distance Measurements») counts z = range_max as valid, discards finite values outside the
    limits, and calls only NaN erroneous. Here z = range_max and finite values above it are NO_RETURN, and finite
    values below range_min are INVALID as NaN is, which discards them.

    TOO_NEAR and NO_RETURN are censored measurements: mappers with an inverse sensor model skip the former, forward
    models take both by the probability of the tail.
    """

    MEASURED = 0
    TOO_NEAR = 1
    NO_RETURN = 2
    INVALID = 3


MAX_BEAMS = 1 << 20
"""No scanner takes more beams in a sweep: finer ones than every 1.2 arc seconds; set by hand."""

MAX_TIME_INCREMENT = 1e3
"""A longer time from beam to beam (s) is none; set by hand."""

MIN_STEP = 1e-6
"""Beams that are closer to each other (rad) are not apart; set by hand."""

TURN_TOLERANCE = 0.02
"""Beams may reach over a turn by this share of it: some drivers count a beam more; set by hand."""

MAX_FIELD = 2 * math.tau
"""Beams that reach farther (rad) are not in radians: no sweep makes two turns; set by hand."""

STEP_TOLERANCE = 0.02
"""A number of steps this near to a whole one is one: angles are in single precision; set by hand."""

_MEASURED, _TOO_NEAR, _NO_RETURN, _INVALID = (np.int8(outcome) for outcome in RangeOutcome)


@dataclass(frozen=True, slots=True)
class Scan:
    """One sweep of a LiDAR, or a part of one, with the fields of sensor_msgs/LaserScan.

    :class:`RangeOutcome` defines what a range means.

    Attributes:
        stamp: Time of the first beam (ns).
        frame_id: The laser's frame.
        angle_min: Bearing of the first beam (rad).
        angle_increment: From one beam's bearing to the next one's (rad).
        range_min: The shortest range that can be measured (m).
        range_max: The longest one (m).
        ranges: (N,) m.
        time_increment: From one beam to the next (s).
        scan_time: From one scan to the next (s).
        first_beam: Which beam of the sweep the first one is: not 0 in a part of a sweep.
        angle_max: Bearing of the last beam as the log says it (rad); NaN where it does not. Beams are where
            ``angle_increment`` puts them; :func:`reconciled_angles` compares both.
    """

    stamp: int
    frame_id: str
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    time_increment: float = 0.0
    scan_time: float = 0.0
    first_beam: int = 0
    angle_max: float = math.nan

    @property
    def problem(self) -> str | None:
        """What makes the whole scan unusable; None where nothing does."""
        if len(self.ranges) > MAX_BEAMS:
            return f"{len(self.ranges)} beams, more than {MAX_BEAMS}"
        if not (
            math.isfinite(self.angle_min) and math.isfinite(self.angle_increment) and math.isfinite(self.range_min)
        ):
            angles = f"angle_min {self.angle_min:g}, angle_increment {self.angle_increment:g}"
            return f"{angles}, range_min {self.range_min:g}"
        if len(self.ranges) > 1 and self.angle_increment == 0:
            return "angle_increment 0, and no other angle_max than angle_min"
        if max(abs(self.angle_min), abs(self.angle_increment) * (len(self.ranges) - 1)) > MAX_FIELD:
            angles = f"angle_min {self.angle_min:g}, angle_increment {self.angle_increment:g}"
            return f"{angles} for {len(self.ranges)} beams: these are no radians"
        if not self.range_max > max(self.range_min, 0.0):
            return f"range_max {self.range_max:g} is not above range_min {self.range_min:g} and 0"
        return None

    @property
    def directions(self) -> FloatArray:
        """Unit vectors (N, 2) of the beams in the laser's frame; shared and read-only."""
        return beam_directions(self.angle_min, self.angle_increment, len(self.ranges))

    def outcomes(self) -> NDArray[np.int8]:
        """Classify each range (N,) by :class:`RangeOutcome`; limits are compared in the ranges' own precision."""
        z = self.ranges
        with np.errstate(over="ignore"):  # a limit beyond single precision is an infinite one
            shortest, longest = z.dtype.type(self.range_min), z.dtype.type(self.range_max)
        valid = (z >= shortest) & (z > 0)
        outcomes = np.where(valid, _MEASURED, _INVALID)
        outcomes[valid & (z >= longest)] = _NO_RETURN
        outcomes[z == -np.inf] = _TOO_NEAR
        return outcomes

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which beams (N,) measured the distance to a surface."""
        return np.equal(self.outcomes(), _MEASURED)

    def censored_ranges(self) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Select what a forward sensor model is fitted to.

        Returns:
            Which beams (N,) are used: all but INVALID ones, and TOO_NEAR ones only where range_min > 0 (else nothing
            can be nearer). Their ranges (M,) in m, with +inf for NO_RETURN and -inf for TOO_NEAR.
        """
        outcomes = self.outcomes()
        used = outcomes != _INVALID
        if self.range_min <= 0:
            used &= outcomes != _TOO_NEAR
        ranges = np.where(outcomes == _NO_RETURN, np.float32(np.inf), self.ranges)
        return used, ranges[used]

    def points(self, pose: Pose2D) -> FloatArray:
        """Return the end points (M, 2) of the measured beams, in the parent frame of the laser's ``pose`` (m)."""
        measured = self.measured
        return pose.apply(self.directions[measured] * self.ranges[measured, None].astype(float))


@lru_cache(maxsize=64)
def beam_directions(angle_min: float, angle_increment: float, count: int) -> FloatArray:
    """Compute the unit vectors of a scanner's beams; cached.

    Args:
        angle_min: Bearing of the first beam (rad).
        angle_increment: From one beam's bearing to the next one's (rad).
        count: The number of beams.

    Returns:
        Unit vectors (count, 2) in the laser's frame, read-only.
    """
    bearings = angle_min + angle_increment * np.arange(count)
    directions = np.column_stack((np.cos(bearings), np.sin(bearings)))
    directions.flags.writeable = False
    return directions


@dataclass(frozen=True)
class PosedScan:
    """A scan with the laser's pose.

    Attributes:
        position: The scan's index in the selection that is replayed, from 0; not its index in the log.
        scan: The whole scan.
        pose: The laser's pose in the map frame at the first beam.
        pieces: The scan in parts, each with the laser's pose while it was taken (see :func:`deskew`).
        scanner: Which of the scanners took it, from 0.
    """

    position: int
    scan: Scan
    pose: Pose2D
    pieces: Sequence[tuple[Scan, Pose2D]]
    scanner: int = 0

    @property
    def points(self) -> FloatArray:
        """End points (M, 2) of the measured beams in the map frame (m)."""
        return np.concatenate([scan.points(pose) for scan, pose in self.pieces])


def deskew(
    scan: Scan, pose: Pose2D, end: Pose2D | None, tolerance: float, max_pieces: int = 64
) -> list[tuple[Scan, Pose2D]]:
    """Compensate for the laser's motion during a scan by cutting the scan into pieces with a pose each.

    The motion from ``pose`` to ``end`` is taken to be uniform.

    Args:
        scan: The scan.
        pose: The laser's pose at the first beam.
        end: The laser's pose at the last beam; None where it did not move.
        tolerance: How far the motion may displace a measured point within one piece (m).
        max_pieces: The number of pieces that is not exceeded, even where the tolerance then is.

    Returns:
        The pieces in the order of their beams, each with the pose at its middle beam. One piece, ``scan`` at
        ``pose``, where the motion is within the tolerance.
    """
    if end is None:
        return [(scan, pose)]
    dx, dy, turn = end.x - pose.x, end.y - pose.y, wrap_angle(end.theta - pose.theta)
    measured = scan.ranges[scan.measured]
    reach = float(measured.max()) if len(measured) else 0.0
    count = min(math.ceil((math.hypot(dx, dy) + abs(turn) * reach) / tolerance), max_pieces, len(scan.ranges))
    if count <= 1:
        return [(scan, pose)]
    edges = np.linspace(0, len(scan.ranges), count + 1).astype(int).tolist()
    last = max(len(scan.ranges) - 1, 1)
    seconds = scan.time_increment if abs(scan.time_increment) <= MAX_TIME_INCREMENT else 0.0  # 0 for NaN
    pieces = []
    for first, after in pairwise(edges):
        share = (first + after - 1) / 2 / last
        piece = replace(
            scan,
            stamp=scan.stamp + round(first * seconds * 1e9),
            angle_min=scan.angle_min + first * scan.angle_increment,
            ranges=scan.ranges[first:after],
            first_beam=first,
        )
        at = Pose2D(pose.x + share * dx, pose.y + share * dy, wrap_angle(pose.theta + share * turn), pose.covariance)
        pieces.append((piece, at))
    return pieces


def reconciled_angles(scan: Scan) -> tuple[Scan, str | None]:
    """Return a scan whose beams end at its ``angle_max``, where its ``angle_increment`` contradicts that.

    The increment remains where it can be right and the ends cannot: where they are more than a turn apart,
    ``angle_max`` alone is 0 (it was not set), or the scan has fewer ranges than the angles are for, which leaves a
    whole number of steps between the ends.

    Args:
        scan: The scan. An increment that ends within two beams, or one hundredth of the field of view, of angle_max
            does not contradict it: many drivers count one beam more or less.

    Returns:
        The scan, itself where nothing contradicts, or its ends say no more; and what contradicts what and
        which is used, None where nothing does.
    """
    steps = len(scan.ranges) - 1
    field = scan.angle_max - scan.angle_min
    if steps < 1 or not math.isfinite(field) or field == 0:
        return scan, None
    end = scan.angle_increment * steps
    allowed = max(2 * abs(field) / steps, abs(field) / 100)
    if abs(end - field) <= allowed or _ends_at_a_turn_from(end, field, allowed):
        return scan, None
    if _is_field(end, steps):
        if not _is_field(field, steps):
            return scan, _INCREMENT_REMAINS
        if scan.angle_max == 0:
            return scan, _INCREMENT_REMAINS
        if _is_cut_short(field / scan.angle_increment, steps):
            return scan, _CUT_SHORT
    return replace(scan, angle_increment=field / steps), _ENDS_DECIDE


_ENDS_DECIDE = "angle_increment contradicts angle_min and angle_max in {}: beams are spread evenly between these"
_INCREMENT_REMAINS = "angle_max contradicts angle_min and angle_increment in {}: it is not used"
_CUT_SHORT = (
    "there are fewer ranges than angle_max and angle_increment say in {}: the last beams are taken to be missing"
)


def _is_field(field: float, steps: int) -> bool:
    """Return whether beams can reach over an angle (rad): finite, more than nothing, and a turn at most."""
    return MIN_STEP * steps < abs(field) <= math.tau * (1 + TURN_TOLERANCE)  # False for NaN


def _ends_at_a_turn_from(end: float, field: float, allowed: float) -> bool:
    """Return whether angle_max is where beams end, but for a turn (rad) by which it was wrapped."""
    opposed = abs(field) <= allowed or (end < 0) != (field < 0)
    return opposed and abs(end) <= math.tau + allowed and abs(abs(end - field) - math.tau) <= allowed


def _is_cut_short(expected: float, steps: int) -> bool:
    """Return whether more steps are ``expected`` by the ends: a whole number, and no multiple of those there are."""
    whole = round(expected)
    if whole <= steps or abs(expected - whole) > STEP_TOLERANCE:
        return False
    return all(whole % count for count in (steps - 1, steps, steps + 1) if count > 0)


def mirror_scan(scan: Scan) -> Scan:
    """Return the scan of a laser that is mounted upside down as one that is not would have taken it."""
    return replace(scan, angle_min=-scan.angle_min, angle_increment=-scan.angle_increment)
