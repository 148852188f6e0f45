"""Poses, trajectories and scans (metres, radians, nanosecond stamps; x forward, y left)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prim.arrays import FloatArray, Stamps


@dataclass(frozen=True, slots=True)
class Pose2D:
    """Where a frame stands in its parent: x, y (m), theta (rad) and, where known, their 3 x 3 covariance."""

    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0
    covariance: FloatArray | None = None

    def __matmul__(self, child: Pose2D) -> Pose2D:
        """The child's pose, given in this frame, in this frame's parent; independent covariances add up."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        dx, dy = cos * child.x - sin * child.y, sin * child.x + cos * child.y
        return Pose2D(
            self.x + dx,
            self.y + dy,
            wrap_angle(self.theta + child.theta),
            self._compose_covariance(child, dx, dy, cos, sin),
        )

    def _compose_covariance(self, child: Pose2D, dx: float, dy: float, cos: float, sin: float) -> FloatArray | None:
        if self.covariance is None and child.covariance is None:
            return None
        total = np.zeros((3, 3))
        if self.covariance is not None:
            own = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1]])
            total += own @ self.covariance @ own.T
        if child.covariance is not None:
            turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
            total += turn @ child.covariance @ turn.T
        return total

    def inverse(self) -> Pose2D:
        """The parent's pose in this frame (without covariance)."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        return Pose2D(-cos * self.x - sin * self.y, sin * self.x - cos * self.y, -self.theta)

    def apply(self, points: ArrayLike) -> FloatArray:
        """Points (N, 2) of this frame in the parent frame."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        moved: FloatArray = np.asarray(points) @ np.array([[cos, sin], [-sin, cos]])
        moved += self.x, self.y
        return moved


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time: ``stamps`` (N,) ns, strictly rising; ``poses`` (N, 3) as x, y, theta.

    Raises ValueError on shapes that do not fit or stamps that do not rise.
    """

    stamps: Stamps
    poses: FloatArray

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.stamps), 3):
            raise ValueError(f"{len(self.stamps)} stamps need poses ({len(self.stamps)}, 3), not {self.poses.shape}")
        if (np.diff(self.stamps) <= 0).any():
            raise ValueError("the stamps of a trajectory must rise strictly")

    def __len__(self) -> int:
        return len(self.stamps)

    def __iter__(self) -> Iterator[Pose2D]:
        return (Pose2D(x, y, theta) for x, y, theta in self.poses.tolist())

    @classmethod
    def from_unsorted(cls, stamps: ArrayLike, poses: ArrayLike) -> Trajectory:
        """Sorts by stamp and, of poses with the same stamp, keeps the one that came last."""
        raw_stamps = np.asarray(stamps, dtype=np.int64)
        raw_poses = np.asarray(poses, dtype=float).reshape(-1, 3)
        order = np.argsort(raw_stamps, kind="stable")
        rising = raw_stamps[order]
        last = np.append(np.diff(rising) > 0, True) if len(rising) else np.zeros(0, dtype=bool)
        return cls(rising[last], raw_poses[order][last])

    def at(self, stamps: Stamps) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Interpolated poses (M, 3) at ``stamps`` (M,), and which of them lie within the trajectory's time.

        Angles turn the short way. Outside the trajectory's time the nearest end is given, marked False.
        """
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, max(len(self) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self) - 1)
        span = np.maximum(self.stamps[after] - self.stamps[before], 1)
        share = np.clip((stamps - self.stamps[before]) / span, 0.0, 1.0)[:, None]
        step = self.poses[after] - self.poses[before]
        step[:, 2] = wrap_angles(step[:, 2])
        poses = self.poses[before] + share * step
        poses[:, 2] = wrap_angles(poses[:, 2])
        return poses, (stamps >= self.stamps[0]) & (stamps <= self.stamps[-1])


def wrap_angle(angle: float) -> float:
    """The angle (rad) in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def wrap_angles(angles: FloatArray) -> FloatArray:
    """Angles (rad) in [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
