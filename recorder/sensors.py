"""The robot's sensors: a LiDAR, a GPS and a compass, each with its own noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from prim.arrays import FloatArray
from prim.log.messages import LASER_FRAME
from prim.scan import Scan, beam_directions
from prim.se2 import Pose2D
from prim.world import World


@dataclass(frozen=True)
class Lidar:
    """A 2D LiDAR at the robot's centre: ``rays`` beams over ``fov`` (rad) from -fov/2 to fov/2, both included.

    Ranges (m) get Gaussian noise of ``noise_std`` (m). Then one below ``range_min`` reads -inf and one above
    ``range_max`` +inf, as does a beam that meets nothing within ``range_max`` (REP 117).
    """

    rays: int = 500
    fov: float = 6.28
    range_min: float = 0.032
    range_max: float = 5.0
    noise_std: float = 0.05

    @property
    def angle_increment(self) -> float:
        """Radians between neighbouring beams."""
        return self.fov / (self.rays - 1) if self.rays > 1 else 0.0

    def exact(self, world: World, pose: Pose2D) -> FloatArray:
        """Noise-free ranges (rays,) of a laser at ``pose``; inf beyond ``range_max``."""
        beams = beam_directions(-self.fov / 2, self.angle_increment, self.rays)
        cos, sin = math.cos(pose.theta), math.sin(pose.theta)
        directions = beams @ np.array([[cos, sin], [-sin, cos]])
        distances = world.cast((pose.x, pose.y), directions)
        return np.where(distances > self.range_max, np.inf, distances)

    def measure(self, world: World, pose: Pose2D, stamp: int, period: float, rng: np.random.Generator) -> Scan:
        """One scan at ``stamp`` (ns), all its beams at once; ``period`` (s) is the time between scans."""
        ranges = self.exact(world, pose) + self.noise_std * rng.standard_normal(self.rays)
        ranges[ranges < self.range_min] = -np.inf
        ranges[ranges > self.range_max] = np.inf
        return Scan(
            stamp=stamp,
            frame_id=LASER_FRAME,
            angle_min=-self.fov / 2,
            angle_increment=self.angle_increment,
            range_min=self.range_min,
            range_max=self.range_max,
            ranges=ranges.astype(np.float32),
            scan_time=period,
        )


@dataclass(frozen=True)
class Gps:
    """A position sensor with Gaussian noise of ``noise_std`` (m) on x and y each."""

    noise_std: float = 0.1

    def measure(self, pose: Pose2D, rng: np.random.Generator) -> tuple[float, float]:
        """x, y (m)."""
        dx, dy = self.noise_std * rng.standard_normal(2)
        return pose.x + dx, pose.y + dy


@dataclass(frozen=True)
class Compass:
    """A heading sensor with Gaussian noise of ``noise_std`` (rad)."""

    noise_std: float = math.radians(3)

    def measure(self, pose: Pose2D, rng: np.random.Generator) -> float:
        """The heading (rad)."""
        return pose.theta + self.noise_std * rng.standard_normal()
