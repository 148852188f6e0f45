"""Rigid motions of the plane, SE(2): poses, their composition, their covariances, trajectories.

A pose (x, y, theta) is the position and orientation of a frame in its parent: metres and radians, x forward, y left,
theta counter-clockwise (REP 103). It maps a point p of the frame to R(theta) p + (x, y) in the parent. One pose is a
:class:`Pose2D`; many are an array (N, 3). Covariances are of (x, y, theta) with the errors of all three given in the
parent's axes, and are carried to first order (Smith, Self and Cheeseman, «Estimating uncertain spatial relationships
in robotics», 1990).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prim.arrays import FloatArray, Stamps

MAX_COORDINATE = 1e9
"""No coordinate (m) is taken to be larger: one that a log or a user gives beyond is refused. Doubles are 1e-7 m apart
there. Set by hand."""


@dataclass(frozen=True, slots=True)
class Pose2D:
    """A frame's pose in its parent: x, y (m), theta (rad) and, where known, their 3 x 3 covariance."""

    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0
    covariance: FloatArray | None = None

    def __matmul__(self, child: Pose2D) -> Pose2D:
        """Compose two poses: ``child``, given in this frame, in this frame's parent.

        The heading is wrapped. Covariances are taken as independent and add up; one that is None counts as zero.
        """
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
        """Return the parent's pose in this frame, without covariance."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        return Pose2D(-cos * self.x - sin * self.y, sin * self.x - cos * self.y, -self.theta)

    def apply(self, points: ArrayLike) -> FloatArray:
        """Return points (N, 2) of this frame in the parent frame (m)."""
        moved = rotate(points, self.theta)
        moved += self.x, self.y
        return moved


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time.

    Attributes:
        stamps: (N,) ns, strictly rising.
        poses: (N, 3) as x, y (m), theta (rad).

    Raises:
        ValueError: The shapes do not fit, or the stamps do not rise.
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
        """Sort poses by stamp; of those with the same stamp the last one remains.

        Args:
            stamps: (N,) ns.
            poses: (N, 3) as x, y (m), theta (rad).

        Returns:
            The trajectory, of at most N poses.
        """
        raw_stamps = np.asarray(stamps, dtype=np.int64)
        raw_poses = np.asarray(poses, dtype=float).reshape(-1, 3)
        order = np.argsort(raw_stamps, kind="stable")
        rising = raw_stamps[order]
        last = np.append(np.diff(rising) > 0, True) if len(rising) else np.zeros(0, dtype=bool)
        return cls(rising[last], raw_poses[order][last])

    def at(self, stamps: Stamps) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Interpolate the poses at many stamps at once: linearly, headings along the shorter arc.

        Args:
            stamps: (M,) ns, in any order.

        Returns:
            Poses (M, 3), and which stamps (M,) lie within the trajectory's time; outside of it the pose is that of
            the nearer end.
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
    """Return one angle (rad) in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def wrap_angles(angles: FloatArray) -> FloatArray:
    """Return an array of angles (rad), of any shape, in [-pi, pi): :func:`wrap_angle` of many."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def angle_difference(a: float, b: float, period: float = 2 * math.pi) -> float:
    """Subtract angles modulo a period: with the default one, ``wrap_angle(a - b)``.

    Args:
        a: An angle (rad).
        b: What is subtracted (rad).
        period: The period (rad).

    Returns:
        a - b in [-period/2, period/2).
    """
    return (a - b + period / 2) % period - period / 2


def rotate(points: ArrayLike, theta: float) -> FloatArray:
    """Rotate points about the origin, counter-clockwise.

    Args:
        points: (N, 2), any unit.
        theta: The angle (rad).

    Returns:
        The rotated points (N, 2), a new array.
    """
    cos, sin = math.cos(theta), math.sin(theta)
    rotated: FloatArray = np.asarray(points) @ np.array([[cos, sin], [-sin, cos]])
    return rotated


def compose_poses(poses: FloatArray, children: FloatArray) -> FloatArray:
    """Compose poses pairwise, as ``Pose2D.__matmul__`` but with headings that are not wrapped.

    Args:
        poses: (N, 3) of frames.
        children: (N, 3), each given in the frame of the pose with the same index (an extrinsic calibration, a mount).

    Returns:
        The children's poses (N, 3) in the parent of ``poses``.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cos * children[:, 0] - sin * children[:, 1]
    y = poses[:, 1] + sin * children[:, 0] + cos * children[:, 1]
    return np.column_stack((x, y, poses[:, 2] + children[:, 2]))


def inverse_poses(poses: FloatArray) -> FloatArray:
    """Return the inverses (N, 3) of poses (N, 3): what they are composed with to give the identity."""
    return relative_poses(poses, np.zeros_like(poses))


def relative_poses(poses: FloatArray, others: FloatArray) -> FloatArray:
    """Compute poses relative to others, pairwise: the inverse of :func:`compose_poses`, with headings wrapped.

    Args:
        poses: (N, 3) of the frames to refer to.
        others: (N, 3) in the same parent.

    Returns:
        ``others`` (N, 3) in the frames of ``poses``.
    """
    change = others - poses
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = cos * change[:, 0] + sin * change[:, 1], cos * change[:, 1] - sin * change[:, 0]
    return np.column_stack((x, y, wrap_angles(change[:, 2])))


def relative_steps(poses: FloatArray) -> FloatArray:
    """Compute each pose (N, 3) relative to the one before it; the first row is zero."""
    steps = np.zeros_like(poses)
    steps[1:] = relative_poses(poses[:-1], poses[1:])
    return steps


def integrate_steps(steps: FloatArray, start: FloatArray | None = None) -> FloatArray:
    """Chain relative poses (dead reckoning): the inverse of :func:`relative_steps`.

    Args:
        steps: (N, 3), each relative to the pose before it; the first to ``start``.
        start: The pose (3,) before the first step; None: the origin.

    Returns:
        The poses (N, 3) after each step, with headings that are not wrapped.
    """
    x, y, theta = np.zeros(3) if start is None else start
    heading = theta + np.cumsum(steps[:, 2])
    before = np.concatenate(([theta], heading[:-1]))
    cos, sin = np.cos(before), np.sin(before)
    dx, dy = cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1]
    return np.column_stack((x + np.cumsum(dx), y + np.cumsum(dy), heading))


def path_length(poses: FloatArray) -> float:
    """Return the length (m) of the way along poses (N, 3)."""
    steps = np.diff(poses[:, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


def compose_covariances(covariances: FloatArray, poses: FloatArray, children: FloatArray) -> FloatArray:
    """Carry covariances of poses over to frames that are mounted on them without error.

    Args:
        covariances: (N, 3, 3) of ``poses``.
        poses: (N, 3).
        children: (N, 3), each given in the frame of the pose with the same index.

    Returns:
        The covariances (N, 3, 3) of ``compose_poses(poses, children)``.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    jacobian = np.broadcast_to(np.eye(3), (len(poses), 3, 3)).copy()
    jacobian[:, 0, 2] = -(sin * children[:, 0] + cos * children[:, 1])
    jacobian[:, 1, 2] = cos * children[:, 0] - sin * children[:, 1]
    carried: FloatArray = jacobian @ covariances @ jacobian.transpose(0, 2, 1)
    return carried


def frame_motions(covariances: FloatArray, poses: FloatArray) -> FloatArray:
    """Compute the covariances of the motions of a frame by which errors of poses move what is seen from them.

    Args:
        covariances: (N, 3, 3) of the poses.
        poses: (N, 3) in the frame.

    Returns:
        (N, 3, 3) of the frame's pose, at its origin and in its axes: the inverse of :func:`frame_covariances`.
    """
    jacobian = np.broadcast_to(np.eye(3), (len(poses), 3, 3)).copy()
    jacobian[:, 0, 2], jacobian[:, 1, 2] = poses[:, 1], -poses[:, 0]
    motions: FloatArray = jacobian @ covariances @ jacobian.transpose(0, 2, 1)
    return motions


def frame_covariances(covariance: FloatArray, poses: FloatArray) -> FloatArray:
    """Compute what an uncertain frame adds to the covariances of poses that are given in it.

    Args:
        covariance: (3, 3) of the frame's own pose, its errors given at its origin and in its axes; or (N, 3, 3),
            one for each pose.
        poses: (N, 3) in the frame.

    Returns:
        The covariances (N, 3, 3) of the poses that come of the frame's error alone.
    """
    jacobian = np.broadcast_to(np.eye(3), (len(poses), 3, 3)).copy()
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -poses[:, 1], poses[:, 0]
    added: FloatArray = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return added
