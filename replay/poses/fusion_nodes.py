"""The time axis of a fusion: odometry steps, fixes and headings at the nodes of one list of stamps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.se2 import Trajectory, integrate_steps, relative_steps, wrap_angles
from replay.poses.fusion_options import DEFAULTS, FusionOptions

TimedValues = tuple[Stamps, FloatArray]
"""Stamps (M,) in ns, rising, and the values measured then: (M,) or (M, columns)."""


@dataclass(frozen=True)
class FusionNodes:
    """Measurements on one time axis, as the kernels of :mod:`replay.poses.kalman` take them.

    Attributes:
        stamps: (N,) ns, strictly rising.
        steps: Motions (N, 3) since the node before, in the robot's frame there; zeros without odometry.
        variance_scales: What the variances of each step are proportional to (N,). With odometry a length in m: the
            odometry's path, plus ``rotation_distance`` a radian turned and ``idle_distance`` a second (FusionOptions;
            by default 0.03 m and 0.4 mm). Without odometry the time in s.
        intervals: Times (N,) since the node before (s); 0 at the first one.
        fixes: Positions of the antenna (N, 2) in m; NaN where there is none.
        fix_scales: Factors (N,) of each fix's standard deviation; 1 where it is not stated.
        stated_fix_std: The median of those that are stated (m); None where none is.
        headings: Headings (N,) in rad; NaN where there is none.
        has_north: Whether the headings are absolute but for a bias: those of a compass, not of an IMU, whose 0 is
            anywhere.
        lever_arm: The antenna's position on the robot (2,) in m.
        initial_pose: The odometry's pose (3,) at the first node.
        has_odometry: Whether the steps are measured.
    """

    stamps: Stamps
    steps: FloatArray
    variance_scales: FloatArray
    intervals: FloatArray
    fixes: FloatArray
    fix_scales: FloatArray
    stated_fix_std: float | None
    headings: FloatArray
    has_north: bool
    lever_arm: FloatArray
    initial_pose: FloatArray
    has_odometry: bool

    @classmethod
    def from_readings(
        cls,
        stamps: Stamps,
        odometry: Trajectory | None,
        fixes: TimedValues | None,
        headings: TimedValues | None,
        lever_arm: tuple[float, float] = (0.0, 0.0),
        options: FusionOptions = DEFAULTS,
        fix_stds: FloatArray | None = None,
        has_north: bool = True,
    ) -> FusionNodes:
        """Place nodes at the stamps that poses are asked for, and at those of all fixes and headings.

        Nodes outside the odometry's time are left out; without odometry, nodes outside the sensors' time.

        Args:
            stamps: When poses are asked for (N,) in ns.
            odometry: The robot's poses by odometry, interpolated to the nodes.
            fixes: Positions of the antenna (M, 2) in m.
            headings: Headings (M,) in rad.
            lever_arm: The antenna's position on the robot (m).
            options: How much of the variance scales is due to turns and to time.
            fix_stds: The fixes' stated standard deviations (M,) in m; NaN where there is none.
            has_north: Whether the headings are those of a compass.

        Returns:
            The nodes by rising stamp.

        Raises:
            ValueError: There is no sensor, or no node within the sensors' time.
        """
        readings = [item[0] for item in (fixes, headings) if item is not None]
        spans = [odometry.stamps] if odometry is not None else readings
        if not spans:
            raise ValueError("there is no sensor at all")
        first, last = min(item[0] for item in spans), max(item[-1] for item in spans)
        nodes = np.unique(np.concatenate((stamps, *readings)))
        nodes = nodes[(nodes >= first) & (nodes <= last)]
        if not len(nodes):
            raise ValueError("nothing lies within the time of the sensors")
        seconds = np.diff(nodes, prepend=nodes[0]) / 1e9
        initial_pose, steps, scales = np.zeros(3), np.zeros((len(nodes), 3)), seconds
        if odometry is not None:
            initial_pose, steps, lengths = _steps_of(odometry, nodes, options)
            scales = lengths + options.idle_distance * seconds
        stated, factors = _relative_stds(fix_stds, options.max_fix_scale)
        given = (fixes[0], factors) if fixes is not None and factors is not None else None
        return cls(
            nodes,
            steps,
            scales,
            seconds,
            _at_nodes(nodes, fixes, 2),
            np.nan_to_num(_at_nodes(nodes, given, 1)[:, 0], nan=1.0),
            stated,
            _at_nodes(nodes, headings, 1)[:, 0],
            has_north,
            np.array(lever_arm),
            initial_pose,
            odometry is not None,
        )

    @property
    def has_fix(self) -> NDArray[np.bool_]:
        """Which nodes (N,) have a fix."""
        return ~np.isnan(self.fixes[:, 0])

    @property
    def has_heading(self) -> NDArray[np.bool_]:
        """Which nodes (N,) have a heading."""
        return ~np.isnan(self.headings)

    def subrange(self, begin: int, end: int | None) -> FusionNodes:
        """Return a run of neighbouring nodes.

        Args:
            begin: The index of the first.
            end: The index after the last; None: to the end.

        Returns:
            The nodes, with the initial pose of all.
        """
        piece = slice(begin, end)
        return replace(
            self,
            stamps=self.stamps[piece],
            steps=self.steps[piece],
            variance_scales=self.variance_scales[piece],
            intervals=self.intervals[piece],
            fixes=self.fixes[piece],
            fix_scales=self.fix_scales[piece],
            headings=self.headings[piece],
        )

    def subset(self, indices: NDArray[np.intp]) -> FusionNodes:
        """Return some of the nodes, by rising index and with the first one, with the steps from each to the next."""
        poses = integrate_steps(self.steps)[indices]
        scales = np.diff(np.cumsum(self.variance_scales)[indices], prepend=0.0)
        return replace(
            self,
            stamps=self.stamps[indices],
            steps=relative_steps(poses),
            variance_scales=scales,
            intervals=np.diff(self.stamps[indices], prepend=self.stamps[indices[:1]]) / 1e9,
            fixes=self.fixes[indices],
            fix_scales=self.fix_scales[indices],
            headings=self.headings[indices],
        )


def _steps_of(
    odometry: Trajectory, nodes: Stamps, options: FusionOptions
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return an odometry's first pose (3,), and the step (N, 3) to each node with its weighted length (N,)."""
    poses, _ = odometry.at(nodes)
    lengths = np.interp(nodes, odometry.stamps, weighted_path_lengths(odometry, options.rotation_distance))
    return poses[0], relative_steps(poses), np.diff(lengths, prepend=lengths[0])


def _at_nodes(nodes: Stamps, readings: TimedValues | None, columns: int) -> FloatArray:
    """Return readings (N, columns) at the nodes with their stamps; NaN elsewhere."""
    values = np.full((len(nodes), columns), np.nan)
    if readings is not None:
        within = (readings[0] >= nodes[0]) & (readings[0] <= nodes[-1])
        values[np.searchsorted(nodes, readings[0][within])] = readings[1].reshape(-1, columns)[within]
    return values


def _relative_stds(stds: FloatArray | None, most: float) -> tuple[float | None, FloatArray | None]:
    """Return the median of stated standard deviations (M,), and what each is of it; None where none is stated."""
    if stds is None or not np.isfinite(stds).any():
        return None, None
    median = float(np.nanmedian(stds))
    return median, np.clip(np.nan_to_num(stds / median, nan=1.0), 1 / most, most)


def weighted_path_lengths(odometry: Trajectory, rotation_distance: float) -> FloatArray:
    """Compute the length of the path up to each pose, with turns counted as distance.

    Args:
        odometry: N poses.
        rotation_distance: The distance (m) that a turn by one radian counts as.

    Returns:
        Lengths (N,) in m from the first pose on.
    """
    change = np.diff(odometry.poses, axis=0)
    lengths = np.hypot(change[:, 0], change[:, 1]) + rotation_distance * np.abs(wrap_angles(change[:, 2]))
    return np.concatenate(([0.0], np.cumsum(lengths)))
