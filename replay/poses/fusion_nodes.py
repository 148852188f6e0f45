"""The time axis of a fusion: odometry steps, fixes and headings at the nodes of one list of stamps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.se2 import Trajectory, integrate_steps, relative_steps, wrap_angles
from replay.poses.fusion_options import FusionOptions

TimedValues = tuple[Stamps, FloatArray]
"""Stamps (M,) in ns, rising, and the values measured then: (M,) or (M, columns)."""

DEFAULTS = FusionOptions()


@dataclass(frozen=True)
class FusionNodes:
    """Measurements on one time axis, as the kernels of :mod:`replay.poses.kalman` take them.

    Attributes:
        stamps: (N,) ns, strictly rising.
        steps: Motions (N, 3) since the node before, in the robot's frame there; zeros without odometry.
        variance_scales: What the variances of each step are proportional to (N,). With odometry a length in m: the
            odometry's path, plus ``rotation_distance`` a radian turned and ``idle_distance`` a second (FusionOptions;
            by default 0.03 m and 0.4 mm). Without odometry the time in s.
        fixes: Positions of the antenna (N, 2) in m; NaN where there is none.
        headings: Compass headings (N,) in rad; NaN where there is none.
        lever_arm: The antenna's position on the robot (2,) in m.
        initial_pose: The odometry's pose (3,) at the first node.
        has_odometry: Whether the steps are measured.
    """

    stamps: Stamps
    steps: FloatArray
    variance_scales: FloatArray
    fixes: FloatArray
    headings: FloatArray
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
    ) -> FusionNodes:
        """Place nodes at the stamps that poses are asked for, and at those of all fixes and headings.

        Nodes outside the odometry's time are left out; without odometry, nodes outside the sensors' time.

        Args:
            stamps: When poses are asked for (N,) in ns.
            odometry: The robot's poses by odometry, interpolated to the nodes.
            fixes: Positions of the antenna (M, 2) in m.
            headings: Compass headings (M,) in rad.
            lever_arm: The antenna's position on the robot (m).
            options: How much of the variance scales is due to turns and to time.

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
        initial_pose = np.zeros(3)
        if odometry is None:
            steps, scales = np.zeros((len(nodes), 3)), np.diff(nodes, prepend=nodes[0]) / 1e9
        else:
            poses, _ = odometry.at(nodes)
            initial_pose, steps = poses[0], relative_steps(poses)
            lengths = weighted_path_lengths(odometry, options.rotation_distance)
            scales = np.diff(np.interp(nodes, odometry.stamps, lengths), prepend=0.0)
            scales[0] = 0.0
            scales += options.idle_distance * np.diff(nodes, prepend=nodes[0]) / 1e9
        return cls(
            nodes,
            steps,
            scales,
            _at_nodes(nodes, fixes, 2),
            _at_nodes(nodes, headings, 1)[:, 0],
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
            fixes=self.fixes[piece],
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
            fixes=self.fixes[indices],
            headings=self.headings[indices],
        )


def _at_nodes(nodes: Stamps, readings: TimedValues | None, columns: int) -> FloatArray:
    """Return readings (N, columns) at the nodes with their stamps; NaN elsewhere."""
    values = np.full((len(nodes), columns), np.nan)
    if readings is not None:
        within = (readings[0] >= nodes[0]) & (readings[0] <= nodes[-1])
        values[np.searchsorted(nodes, readings[0][within])] = readings[1].reshape(-1, columns)[within]
    return values


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
