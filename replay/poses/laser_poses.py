"""When poses of the laser are asked for, and what is found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.choices import PoseSourceName
from prim.se2 import Pose2D

if TYPE_CHECKING:
    from replay.poses.fusion import Fusion

FUSED = PoseSourceName.FUSED.value

STILL = "still"
"""The source of poses of a robot that stands still."""

EXACT_SOURCES = (PoseSourceName.TRUTH.value, STILL)
"""The sources of poses without errors."""


@dataclass(frozen=True)
class ScanTimes:
    """When N scans were taken.

    Attributes:
        stamps: Of each scan's first beam (N,) in ns.
        frame_id: The laser's frame.
        sweep: The time (ns) from a scan's first beam to its last; 0: all beams are taken at once.
    """

    stamps: Stamps
    frame_id: str
    sweep: int = 0

    @property
    def query_stamps(self) -> Stamps:
        """When poses are asked for: at the first beams (N,) and, where a sweep takes time, the last ones (2N,)."""
        return np.concatenate((self.stamps, self.stamps + self.sweep)) if self.sweep else self.stamps


@dataclass(frozen=True)
class FusedSensor:
    """A sensor that poses were fused from.

    Attributes:
        name: One of fusion_options.SENSORS.
        topic: Its topic.
        used: How many readings were used.
        rejected: How many were rejected as outliers.
        std: Its standard deviations, as far as they are given or estimated, by unit: ``m`` and ``rad``. Those of the
            odometry are after one metre.
        bias: The constant offset of a compass's headings (rad).
    """

    name: str
    topic: str
    used: int
    rejected: int
    std: Mapping[str, float]
    bias: float = 0.0


@dataclass(frozen=True)
class LaserPoses:
    """The laser's pose at each of N scans.

    Attributes:
        source: One of PoseSourceName but auto, or STILL.
        origin: The topics or frames that the poses come from, for people.
        poses: (N, 3) x, y (m), heading (rad) in the map frame.
        valid: Which scans (N,) lie within the time of the poses.
        upside_down: Whether the laser turns the other way.
        notes: What a user should know: what was assumed or left out.
        end_poses: The poses (N, 3) at each scan's last beam; None: those at the first.
        covariances: The poses' covariances (N, 3, 3), where they are known.
        frame_covariance: The covariance (3, 3) of the map frame itself (see PoseEstimate.frame_covariance), where it
            is known.
        sensors: The sensors that the poses were fused from.
        fusion: The fusion that they come from.
        mounts: The laser's poses (N, 3) on the robot whose poses were fused.
        matched: Whether the poses are corrected by matching the scans with the map.
        mount_assumed: Whether the laser is only taken to be at the robot's origin: nothing tells its mount.
    """

    source: str
    origin: str
    poses: FloatArray
    valid: NDArray[np.bool_]
    upside_down: bool = False
    notes: tuple[str, ...] = ()
    end_poses: FloatArray | None = None
    covariances: FloatArray | None = None
    frame_covariance: FloatArray | None = None
    sensors: tuple[FusedSensor, ...] = ()
    fusion: Fusion | None = None
    mounts: FloatArray | None = None
    matched: bool = False
    mount_assumed: bool = False

    @property
    def max_std(self) -> tuple[float, float] | None:
        """The largest standard deviations of position (m) and heading (rad); None where they are not known."""
        if self.covariances is None:
            return (0.0, 0.0) if self.source in EXACT_SOURCES and not self.matched else None
        x, y, theta = np.diagonal(self.covariances, axis1=1, axis2=2)[self.valid].max(axis=0, initial=0.0).tolist()
        if not (0 <= x + y < math.inf and 0 <= theta < math.inf):
            return None
        return math.sqrt(x + y), math.sqrt(theta)

    def at(self, position: int) -> Pose2D:
        """Return the pose of the scan at this index, with its covariance where that is known."""
        covariance = None if self.covariances is None else self.covariances[position]
        x, y, theta = self.poses[position].tolist()
        return Pose2D(x, y, theta, covariance)

    def end_at(self, position: int) -> Pose2D | None:
        """Return the pose at the last beam of the scan at this index; None where that is taken with the first."""
        return None if self.end_poses is None else Pose2D(*self.end_poses[position].tolist())
