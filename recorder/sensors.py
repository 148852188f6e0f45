"""The robot's sensors: a LiDAR, a GPS and a compass, each with its own noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from prim.arrays import FloatArray
from prim.log.messages import LASER_FRAME
from prim.scan import Scan, beam_directions
from prim.se2 import Pose2D, rotate
from prim.world import World
from recorder.faults import (
    DROPOUT_VALUES,
    NO_FAULTS,
    FaultGenerators,
    ScannerFaults,
    reported_echoes,
    sub_ray_offsets,
    with_dropouts,
    with_outliers,
)


@dataclass(frozen=True)
class Lidar:
    """A 2D LiDAR at the robot's centre, all of whose beams measure at once.

    The defaults are the paper's (III-B, IV-A), but for the noise.

    Attributes:
        rays: The number of beams.
        fov: Field of view (rad), from -fov/2 to fov/2, both included.
        range_min: The shortest range that is measured (m).
        range_max: The longest one (m).
        noise_std: Standard deviation of the Gaussian noise on each range (m).
        faults: What else is wrong with its ranges.
    """

    rays: int = 500
    fov: float = 6.28
    range_min: float = 0.032
    range_max: float = 5.0
    noise_std: float = 0.05
    faults: ScannerFaults = NO_FAULTS

    @property
    def angle_increment(self) -> float:
        """From one beam's bearing to the next one's (rad)."""
        return self.fov / (self.rays - 1) if self.rays > 1 else 0.0

    def exact(self, world: World, pose: Pose2D) -> FloatArray:
        """Compute ranges without noise and faults.

        Args:
            world: What is around.
            pose: The laser's pose.

        Returns:
            Ranges (rays,) in m; inf beyond ``range_max``.
        """
        beams = beam_directions(-self.fov / 2, self.angle_increment, self.rays)
        distances = world.cast((pose.x, pose.y), rotate(beams, pose.theta))
        return np.where(distances > self.range_max, np.inf, distances)

    def measure(
        self,
        world: World,
        pose: Pose2D,
        stamp: int,
        period: float,
        rng: np.random.Generator,
        chances: FaultGenerators | None = None,
    ) -> Scan:
        """Take a scan; below ``range_min`` it reads -inf, above ``range_max`` +inf (REP 117).

        The limits are applied after the noise: to surfaces that lie beyond them, and to those that noise moves there.
        Beams that drop out read what the faults say.

        Args:
            world: What is around.
            pose: The laser's pose.
            stamp: The scan's time (ns).
            period: Time between scans (s).
            rng: Draws the noise.
            chances: Draw the faults; None: children of ``rng``.

        Returns:
            The scan.
        """
        faults = self.faults
        if chances is None and faults != NO_FAULTS:
            chances = FaultGenerators.spawned_from(rng)
        distances = self._reported(world, pose, chances) if chances and faults.beam_width else self.exact(world, pose)
        ranges = distances + faults.range_bias + self._noise_stds(distances) * rng.standard_normal(self.rays)
        if chances and faults.outliers:
            ranges = with_outliers(ranges, faults.outliers, (self.range_min, self.range_max), chances.outliers)
        if faults.quantum:
            ranges = np.round(ranges / faults.quantum) * faults.quantum
        ranges[ranges < self.range_min] = -np.inf
        ranges[ranges > self.range_max] = np.inf
        if chances and faults.dropouts:
            value = DROPOUT_VALUES[faults.dropout_as]
            written = self.range_max if value is None else value
            ranges = with_dropouts(ranges, faults.dropouts, written, chances.dropouts)
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

    def _reported(self, world: World, pose: Pose2D, chances: FaultGenerators) -> FloatArray:
        """Compute what distances (rays,) beams of some width report (m)."""
        turned = (Pose2D(pose.x, pose.y, pose.theta + offset) for offset in sub_ray_offsets(self.faults.beam_width))
        distances = np.column_stack([self.exact(world, sub_ray) for sub_ray in turned])
        return reported_echoes(distances, chances.beam.random(self.rays))

    def _noise_stds(self, distances: FloatArray) -> FloatArray | float:
        """Compute the noise's standard deviations (rays,) in m."""
        if not self.faults.noise_growth:
            return self.noise_std
        growth = self.faults.noise_growth * np.where(np.isfinite(distances), distances, 0.0)
        return np.asarray(np.hypot(self.noise_std, growth))


@dataclass(frozen=True)
class Gps:
    """A position sensor.

    Attributes:
        noise_std: Standard deviation of the Gaussian noise on x and on y (m).
    """

    noise_std: float = 0.1

    def measure(self, pose: Pose2D, rng: np.random.Generator) -> tuple[float, float]:
        """Measure the position.

        Args:
            pose: The robot's pose.
            rng: Draws the noise.

        Returns:
            x, y (m).
        """
        dx, dy = self.noise_std * rng.standard_normal(2)
        return pose.x + dx, pose.y + dy


@dataclass(frozen=True)
class Compass:
    """A heading sensor.

    Attributes:
        noise_std: Standard deviation of the Gaussian noise (rad).
    """

    noise_std: float = math.radians(3)

    def measure(self, pose: Pose2D, rng: np.random.Generator) -> float:
        """Measure the heading.

        Args:
            pose: The robot's pose.
            rng: Draws the noise.

        Returns:
            The heading (rad).
        """
        return pose.theta + self.noise_std * rng.standard_normal()
