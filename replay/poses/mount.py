"""The extrinsics of a log's sensors: where they are mounted on the robot, by tf or by an option."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from prim.arrays import FloatArray
from prim.errors import LogReadError
from prim.log.source import LogSource
from prim.se2 import Pose2D
from replay.poses.laser_poses import ScanTimes
from replay.poses.transforms import FIXED_FRAMES, TransformTree, project_to_plane


class LaserMounts(NamedTuple):
    """The laser's pose on the robot at M query stamps.

    Attributes:
        poses: (M, 3) x, y (m), heading (rad).
        upside_down: Whether the laser is mounted upside down.
        notes: What was assumed.
        assumed: Whether the laser is only taken to be at the robot's origin: nothing tells its mount.
    """

    poses: FloatArray
    upside_down: bool
    notes: tuple[str, ...]
    assumed: bool


class SensorMounts:
    """The tf tree of a log, read when it is needed, and the poses of sensors on the robot.

    Args:
        log: The log.
        laser_offset: The laser's pose on the robot, in place of tf.
        min_upright: A laser whose axis has a smaller cosine to the vertical is reported as tilted.
    """

    def __init__(self, log: LogSource, laser_offset: Pose2D | None, min_upright: float) -> None:
        self._log = log
        self._offset = laser_offset
        self._min_upright = min_upright
        self.tree_notes: tuple[str, ...] = ()

    @cached_property
    def tree(self) -> TransformTree:
        """The log's tf tree; an empty one, and a note, where it cannot be read."""
        try:
            return TransformTree.read(self._log)
        except LogReadError as error:
            self.tree_notes = (f"tf is not used: {error.what}",)
            return TransformTree()

    @cached_property
    def _static_tree(self) -> TransformTree:
        """The static transforms, which are read in no time."""
        try:
            return TransformTree.read(self._log, static_only=True)
        except LogReadError:
            return TransformTree()

    def fixed_chain(self, frame: str) -> list[str]:
        """Return the tf chain from ``frame`` up to ``map``, else up to ``odom``, else up to the root of the tree.

        The last only where a transform on the way changes over time; where all are static, the frame alone.
        """
        chain = self.tree.chain(frame)
        for root in FIXED_FRAMES:
            if root in chain:
                return chain[: chain.index(root) + 1]
        moving = any(not self.tree.edges[link][1].static for link in chain[:-1])
        return chain if moving else chain[:1]

    def sensor_mount(self, frame: str, base: str) -> tuple[FloatArray, FloatArray]:
        """Look up a sensor's fixed pose on the robot.

        Args:
            frame: The sensor's frame.
            base: The robot's frame.

        Returns:
            Rotation (3, 3) and translation (3,) in m; those of the base itself where tf has none.
        """
        tree, chain = self._chain_to(base, frame)
        if len(chain) < 2:
            return np.eye(3), np.zeros(3)
        rotation, translation, _ = tree.lookup(chain, np.zeros(1, dtype=np.int64))
        return rotation[0], translation[0]

    def laser_mounts(self, scans: ScanTimes, base: str) -> LaserMounts:
        """Find the laser's pose on the robot at every query stamp.

        Args:
            scans: When poses are asked for, and the laser's frame.
            base: The robot's frame.

        Returns:
            Its poses, and what was assumed.
        """
        frame = scans.frame_id.lstrip("/")
        tree, chain = self._chain_to(base, frame)
        rotation, translation, _ = tree.lookup(chain, scans.query_stamps)
        mounts, upside_down, notes = project_to_plane(rotation, translation, self._min_upright)
        notes += self.tree_notes
        if self._offset is not None:
            mounts[:] = self._offset.x, self._offset.y, self._offset.theta
            notes += (f"--laser-offset stands in for the transform from {base} to {frame}",) * (len(chain) > 1)
        assumed = self._offset is None and frame != base and len(chain) == 1
        if assumed:
            notes += (
                f"no transform from {base} to {frame or 'the scans, which name no frame'}: the laser is taken to be "
                "at the robot's origin; if it is not, give --laser-offset X Y DEG",
            )
        return LaserMounts(mounts, upside_down, notes, assumed)

    def _chain_to(self, base: str, frame: str) -> tuple[TransformTree, list[str]]:
        """Return the frames from ``frame`` up to ``base``, and the tree that has them; else the frame alone."""
        for tree in (self._static_tree, self.tree):
            chain = tree.chain(frame)
            if base in chain:
                return tree, chain[: chain.index(base) + 1]
        return self.tree, chain[:1]
