"""What the robot believes of its own motion: wheel odometry that drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from prim.se2 import Pose2D


@dataclass(frozen=True)
class OdometryNoise:
    """White noise of wheel odometry: its variances grow with the way travelled.

    ``metres`` and ``radians`` are the standard deviations, along and across alike, after one metre.
    """

    metres: float = 0.05
    radians: float = math.radians(2)


class Odometry:
    """Adds up noisy steps from the true start on; the covariance tells how far it may be off.

    The steps are the true ones with white noise on the way forward, on the way aside and on the turn.
    """

    def __init__(self, noise: OdometryNoise, rng: np.random.Generator) -> None:
        self._noise = noise
        self._rng = rng
        self._true: Pose2D | None = None
        self.pose = Pose2D()

    def update(self, true_pose: Pose2D, travelled: float) -> Pose2D:
        """The believed pose after the robot went ``travelled`` metres (of wheel) to ``true_pose``."""
        if self._true is None:
            self.pose = Pose2D(true_pose.x, true_pose.y, true_pose.theta, np.zeros((3, 3)))
        else:
            scale = math.sqrt(travelled)
            std = np.array([self._noise.metres, self._noise.metres, self._noise.radians]) * scale
            step = self._true.inverse() @ true_pose
            dx, dy, dtheta = (std * self._rng.standard_normal(3)).tolist()
            noisy = Pose2D(step.x + dx, step.y + dy, step.theta + dtheta, np.diag(std**2))
            self.pose = self.pose @ noisy
        self._true = true_pose
        return self.pose
