"""When poses of the laser are asked for, and what is found."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.choices import PoseSourceName, SweepName
from prim.scan import PosedScan
from prim.se2 import Pose2D, frame_motions
from replay.poses.fusion_options import Wander

if TYPE_CHECKING:
    from replay.poses.fusion import Fusion

FUSED = PoseSourceName.FUSED.value
SCANS = PoseSourceName.SCANS.value

STILL = "still"
"""The source of poses of a robot that stands still."""

EXACT_SOURCES = (PoseSourceName.TRUTH.value, STILL)
"""The sources of poses without errors."""


class BeamTimes(NamedTuple):
    """When a scan's first and last beams are measured: from its stamp on, in units of the time that a sweep takes."""

    first: float
    last: float


BEAM_TIMES: Mapping[str, BeamTimes] = {
    SweepName.START.value: BeamTimes(0.0, 1.0),
    SweepName.END.value: BeamTimes(-1.0, 0.0),
    SweepName.START_REVERSED.value: BeamTimes(1.0, 0.0),
    SweepName.END_REVERSED.value: BeamTimes(0.0, -1.0),
}
"""The times of beams by the name of the option."""

AT_ONCE = BeamTimes(0.0, 0.0)
"""All beams are measured at the stamp."""


def stated_beam_times(sweep: int) -> BeamTimes:
    """Return what a log says of its beams: they follow the stamp, or go before it where time_increment is negative.

    Args:
        sweep: The time (ns) from a scan's first beam to its last.

    Returns:
        The times of the beams.
    """
    return BEAM_TIMES[SweepName.START if sweep >= 0 else SweepName.END_REVERSED]


@dataclass(frozen=True)
class ScanTimes:
    """When N scans were taken, by one laser or by several.

    Attributes:
        stamps: Of each scan's first beam (N,) in ns.
        frame_ids: The frame of each laser.
        sweeps: For each laser the time (ns) from a scan's first beam to its last, negative where they run against
            time; 0: all beams are taken at once. Empty: 0 for all.
        scanner: By which laser each scan was taken (N,); None: by the only one.
        topics: The topic of each laser's scans; empty where there is one laser.
    """

    stamps: Stamps
    frame_ids: tuple[str, ...]
    sweeps: tuple[int, ...] = ()
    scanner: NDArray[np.intp] | None = None
    topics: tuple[str, ...] = ()

    @property
    def query_stamps(self) -> Stamps:
        """When poses are asked for: at the first beams (N,) and, where a sweep takes time, the last ones (2N,)."""
        if not any(self.sweeps):
            return self.stamps
        sweeps = np.array(self.sweeps, dtype=np.int64)[self._scanner]
        return np.concatenate((self.stamps, self.stamps + sweeps))

    @property
    def sweep(self) -> int:
        """The time (ns) of the first laser's sweep."""
        return self.sweeps[0] if self.sweeps else 0

    def query_rows(self, laser: int) -> NDArray[np.intp]:
        """Return which of the query stamps are those of a laser."""
        rows = np.flatnonzero(self._scanner == laser)
        return np.concatenate((rows, rows + len(self.stamps))) if any(self.sweeps) else rows

    def at_once(self) -> ScanTimes:
        """Return the same scans, all beams of each taken at its stamp."""
        return replace(self, sweeps=())

    @property
    def _scanner(self) -> NDArray[np.intp]:
        return np.zeros(len(self.stamps), dtype=np.intp) if self.scanner is None else self.scanner


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
        bias: The constant offset of headings (rad).
        wander: How its errors wander; None where they do not.
        scales: What the odometry's distances and turns were multiplied by.
    """

    name: str
    topic: str
    used: int
    rejected: int
    std: Mapping[str, float]
    bias: float = 0.0
    wander: Wander | None = None
    scales: tuple[float, float] = (1.0, 1.0)


class PoseLoops(NamedTuple):
    """The loops that were closed in tracked poses.

    Attributes:
        closed: Loops.
        rejected: Keyframes that were recognised and not relied upon, by the reason.
        pairs: (L, 2) the scans that were recognised, each after the one in whose surroundings it was.
    """

    closed: int
    rejected: Mapping[str, int]
    pairs: NDArray[np.intp]


@dataclass(frozen=True)
class LaserPoses:
    """The laser's pose at each of N scans.

    Attributes:
        source: One of PoseSourceName but auto, or STILL.
        origin: The topics or frames that the poses come from, for people.
        poses: (N, 3) x, y (m), heading (rad) in the map frame.
        valid: Which scans (N,) lie within the time of the poses.
        upside_down: At which scans (N,) the laser turns the other way; None: at none.
        notes: What a user should know: what was assumed or left out.
        end_poses: The poses (N, 3) at each scan's last beam; None: those at the first.
        covariances: The poses' covariances (N, 3, 3), where they are known.
        frame_covariance: The covariance (3, 3) of the map frame itself (see PoseEstimate.frame_covariance), where it
            is known.
        sensors: The sensors that the poses were fused from.
        fusion: The fusion that they come from.
        mounts: The laser's poses (N, 3) on the robot, where poses were fused or there are several lasers.
        matched: Whether the poses are corrected by matching the scans with the map.
        mount_assumed: Whether the laser is only taken to be at the robot's origin: its mount is not in the log.
        loops: The loops that were closed; None where none were searched for.
    """

    source: str
    origin: str
    poses: FloatArray
    valid: NDArray[np.bool_]
    upside_down: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()
    end_poses: FloatArray | None = None
    covariances: FloatArray | None = None
    frame_covariance: FloatArray | None = None
    sensors: tuple[FusedSensor, ...] = ()
    fusion: Fusion | None = None
    mounts: FloatArray | None = None
    matched: bool = False
    mount_assumed: bool = False
    loops: PoseLoops | None = None

    @property
    def max_std(self) -> tuple[float, float] | None:
        """The largest standard deviations of position (m) and heading (rad); None where they are not known."""
        if self.covariances is None:
            return (0.0, 0.0) if self.source in EXACT_SOURCES and not self.matched else None
        x, y, theta = np.diagonal(self.covariances, axis1=1, axis2=2)[self.valid].max(axis=0, initial=0.0).tolist()
        if not (0 <= x + y < math.inf and 0 <= theta < math.inf):
            return None
        return math.sqrt(x + y), math.sqrt(theta)

    def frame_covariance_at(self, x: float, y: float) -> FloatArray | None:
        """Return the covariance of the map at a place: of its frame's motion there.

        Args:
            x: M.
            y: M.

        Returns:
            (3, 3) of the frame's x, y (m) and heading (rad), at its origin: that of the whole map where it is one
            piece, else, where poses are tracked along the way, by the laser's pose that is nearest. None where it is
            not known.
        """
        if self.frame_covariance is not None or self.covariances is None or not self.matched:
            return self.frame_covariance
        away = np.where(self.valid, np.hypot(self.poses[:, 0] - x, self.poses[:, 1] - y), np.inf)
        nearest = int(np.argmin(away))
        here = slice(nearest, nearest + 1)
        return np.asarray(frame_motions(self.covariances[here], self.poses[here])[0])

    def at(self, position: int) -> Pose2D:
        """Return the pose of the scan at this index, with its covariance where that is known."""
        covariance = None if self.covariances is None else self.covariances[position]
        x, y, theta = self.poses[position].tolist()
        return Pose2D(x, y, theta, covariance)

    def is_upside_down(self, position: int) -> bool:
        """Return whether the laser is mounted upside down that took the scan at this index."""
        return self.upside_down is not None and bool(self.upside_down[position])

    def end_at(self, position: int) -> Pose2D | None:
        """Return the pose at the last beam of the scan at this index; None where that is taken with the first."""
        return None if self.end_poses is None else Pose2D(*self.end_poses[position].tolist())


PosedScanSource = Callable[[LaserPoses], Iterable[PosedScan]]
"""Yields the scans of a log with the poses that it is given."""
