"""The robot's estimate of its own motion: wheel odometry that drifts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from prim.se2 import Pose2D


@dataclass(frozen=True)
class OdometryNoise:
    """White noise of wheel odometry, whose variances grow in proportion to the distance travelled (path and turns).

    Attributes:
        translation_std: Standard deviation of the position, along and across alike, after one metre (m).
        rotation_std: Standard deviation of the heading after one metre (rad).
    """

    translation_std: float = 0.05
    rotation_std: float = math.radians(2)


class Odometry:
    """Dead reckoning from the true start on: the true steps with white noise on x, y and heading.

    Args:
        noise: The noise of a step.
        rng: Draws it.
    """

    def __init__(self, noise: OdometryNoise, rng: np.random.Generator) -> None:
        self._noise = noise
        self._rng = rng
        self._true: Pose2D | None = None
        self.pose = Pose2D()

    def update(self, true_pose: Pose2D, travelled: float) -> Pose2D:
        """Add a step.

        Args:
            true_pose: The robot's true pose after it.
            travelled: Path and turn during it (m), as :attr:`recorder.motion.Step.travelled`.

        Returns:
            The pose by odometry, with the covariance of its error.
        """
        if self._true is None:
            self.pose = Pose2D(true_pose.x, true_pose.y, true_pose.theta, np.zeros((3, 3)))
        else:
            noise = self._noise
            stds = np.array([noise.translation_std, noise.translation_std, noise.rotation_std])
            std = stds * math.sqrt(travelled)
            step = self._true.inverse() @ true_pose
            dx, dy, dtheta = (std * self._rng.standard_normal(3)).tolist()
            noisy = Pose2D(step.x + dx, step.y + dy, step.theta + dtheta, np.diag(std**2))
            self.pose = self.pose @ noisy
        self._true = true_pose
        return self.pose
