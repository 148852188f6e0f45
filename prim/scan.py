"""One scan of a 2D LiDAR, and the pieces of it that were taken from different poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.se2 import Pose2D, wrap_angle


@dataclass(frozen=True, slots=True)
class Scan:
    """One turn of a LiDAR: ``ranges`` (N,) in metres at bearings angle_min + i * angle_increment (rad).

    Follows sensor_msgs/LaserScan and REP 117: +inf is no return, -inf a return nearer than ``range_min``, NaN
    no measurement. A part of a turn says which of the turn's beams is its ``first_beam``.
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

    @property
    def problem(self) -> str | None:
        """What makes the whole scan unusable, None where nothing does."""
        if not np.isfinite((self.angle_min, self.angle_increment, self.range_min)).all():
            angles = f"angle_min {self.angle_min:g}, angle_increment {self.angle_increment:g}"
            return f"{angles}, range_min {self.range_min:g}"
        if not self.range_max > max(self.range_min, 0.0):
            return f"range_max {self.range_max:g} is not above range_min {self.range_min:g} and 0"
        return None

    @property
    def directions(self) -> FloatArray:
        """Unit vectors (N, 2) of the beams in the laser's frame; shared and read-only."""
        return beam_directions(self.angle_min, self.angle_increment, len(self.ranges))

    @property
    def hits(self) -> NDArray[np.bool_]:
        """Which beams returned from a surface: range_min <= range < range_max and positive."""
        return (self.ranges >= self.range_min) & (self.ranges > 0) & (self.ranges < self.range_max)

    def points(self, pose: Pose2D) -> FloatArray:
        """End points (M, 2) of the beams that hit, in the frame that ``pose`` (of the laser) is given in."""
        hits = self.hits
        return pose.apply(self.directions[hits] * self.ranges[hits, None].astype(float))


@lru_cache(maxsize=64)
def beam_directions(angle_min: float, angle_increment: float, count: int) -> FloatArray:
    """Unit vectors (count, 2) at bearings angle_min + i * angle_increment; cached and read-only."""
    bearings = angle_min + angle_increment * np.arange(count)
    directions = np.column_stack((np.cos(bearings), np.sin(bearings)))
    directions.flags.writeable = False
    return directions


MOST_PIECES = 64
"""A scan whose laser moves meanwhile is cut into no more pieces."""


@dataclass(frozen=True)
class PosedScan:
    """A scan, the laser's pose at its first beam, and the same in ``pieces`` that have a pose of their own each."""

    position: int
    scan: Scan
    pose: Pose2D
    pieces: Sequence[tuple[Scan, Pose2D]]

    @property
    def points(self) -> FloatArray:
        """End points (M, 2) in the map frame of the beams that hit."""
        return np.concatenate([scan.points(pose) for scan, pose in self.pieces])


def pieces_of(scan: Scan, pose: Pose2D, end: Pose2D | None, tolerance: float) -> list[tuple[Scan, Pose2D]]:
    """A scan cut so that each piece's beams are seen from where the laser then was.

    ``end`` is the laser's pose at the last beam, None where it did not move. In between it moves evenly; within a
    piece, it moves what it sees by no more than ``tolerance`` (m), unless there were more than MOST_PIECES pieces.
    """
    if end is None:
        return [(scan, pose)]
    dx, dy, turn = end.x - pose.x, end.y - pose.y, wrap_angle(end.theta - pose.theta)
    hits = scan.ranges[scan.hits]
    reach = float(hits.max()) if len(hits) else 0.0
    count = min(math.ceil((math.hypot(dx, dy) + abs(turn) * reach) / tolerance), MOST_PIECES, len(scan.ranges))
    if count <= 1:
        return [(scan, pose)]
    edges = np.linspace(0, len(scan.ranges), count + 1).astype(int).tolist()
    last = max(len(scan.ranges) - 1, 1)
    pieces = []
    for first, after in pairwise(edges):
        share = (first + after - 1) / 2 / last
        piece = replace(
            scan,
            stamp=scan.stamp + round(first * scan.time_increment * 1e9),
            angle_min=scan.angle_min + first * scan.angle_increment,
            ranges=scan.ranges[first:after],
            first_beam=first,
        )
        at = Pose2D(pose.x + share * dx, pose.y + share * dy, wrap_angle(pose.theta + share * turn), pose.covariance)
        pieces.append((piece, at))
    return pieces


def turned_over(scan: Scan) -> Scan:
    """The scan of a laser that is mounted upside down, as seen from above."""
    return replace(scan, angle_min=-scan.angle_min, angle_increment=-scan.angle_increment)
