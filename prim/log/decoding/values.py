"""What the messages of a log decode to, beside :class:`prim.scan.Scan`: poses, vectors and clouds of points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from prim.arrays import FloatArray
from prim.se2 import Pose2D
from prim.shapes import Primitive

MAX_POINTS = 1 << 22
"""A cloud has no more points: each takes 24 bytes, whatever the message has of it; set by hand."""


class StampedPose(NamedTuple):
    """A pose as messages hold it.

    Attributes:
        stamp: Ns.
        frame_id: The frame that the pose is given in.
        child_frame_id: The frame whose pose it is; empty where the message does not say.
        translation: x, y, z (m).
        rotation: Quaternion x, y, z, w as the message holds it: of unit norm only if it is there.
    """

    stamp: int
    frame_id: str
    child_frame_id: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


class StampedVector(NamedTuple):
    """A point or vector as messages hold it.

    Attributes:
        stamp: Ns.
        frame_id: The frame that it is given in.
        x: m, or latitude (degrees).
        y: m, or longitude (degrees).
        z: m, or altitude (m).
    """

    stamp: int
    frame_id: str
    x: float
    y: float
    z: float


class StampedFix(NamedTuple):
    """A position on the Earth as messages hold it.

    Attributes:
        stamp: Ns.
        frame_id: The frame of the antenna.
        x: Latitude (degrees); NaN without a fix.
        y: Longitude (degrees); NaN without a fix.
        z: Altitude (m); NaN without a fix.
        variance: Of the position along each axis in the plane (m^2), as the receiver has it; NaN where it has none.
    """

    stamp: int
    frame_id: str
    x: float
    y: float
    z: float
    variance: float


class StampedOrientation(NamedTuple):
    """An orientation as messages hold it.

    Attributes:
        stamp: Ns.
        frame_id: The frame of the sensor.
        rotation: The sensor's orientation, a quaternion x, y, z, w as the message holds it; None where it has none.
    """

    stamp: int
    frame_id: str
    rotation: tuple[float, float, float, float] | None


class PointCloud(NamedTuple):
    """A cloud of points.

    Attributes:
        stamp: Ns.
        frame_id: The frame that the points are given in.
        points: (N, 3) x, y, z (m); NaN where a beam has no return.
    """

    stamp: int
    frame_id: str
    points: FloatArray


class StampedPrimitives(NamedTuple):
    """The primitives of a recorded world.

    Attributes:
        stamp: Since when they are so (ns); 0 where there are none.
        primitives: The primitives, in the map frame.
    """

    stamp: int
    primitives: tuple[Primitive, ...]


def planar_pose(pose: StampedPose) -> Pose2D:
    """Project a pose, whose quaternion has unit norm, onto the x-y plane: x, y and the heading of the x axis."""
    x, y, z, w = pose.rotation
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return Pose2D(pose.translation[0], pose.translation[1], heading)


def quaternion(heading: float) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of a turn about the z axis (rad)."""
    return 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)


def plane_variance(covariance: Sequence[float], is_known: bool) -> float:
    """Find the variance of a position in the plane.

    Args:
        covariance: That of x, y, z: (9,) in m^2.
        is_known: Whether the message says that it is.

    Returns:
        The mean along x and y; NaN where it is not known, or cannot be one.
    """
    if not is_known or len(covariance) != 9:
        return math.nan
    variance = (covariance[0] + covariance[4]) / 2
    return variance if min(covariance[0], covariance[4]) > 0 and variance < math.inf else math.nan


def checked_count(points: int) -> int:
    """Return a number of points that a cloud may have. Raises ValueError."""
    if points > MAX_POINTS:
        raise ValueError(f"a cloud of {points} points, more than {MAX_POINTS}")
    return points


def checked_stamp(stamp: int) -> int:
    """Return a stamp (ns) that fits into 64 bits, and leaves room to compute with. Raises ValueError."""
    if abs(stamp) >= 1 << 62:
        raise ValueError("its stamp is beyond all times (2^62 ns)")
    return stamp
