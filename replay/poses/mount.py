"""The extrinsics of a log's sensors: where they are mounted on the robot, by tf or by an option."""

from __future__ import annotations

import re
import shlex
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.errors import LogReadError, UsageError
from prim.log.messages import BASE_FRAME
from prim.log.source import LogSource
from prim.se2 import Pose2D
from replay.poses.laser_poses import ScanTimes
from replay.poses.transforms import FIXED_FRAMES, TransformTree, project_to_plane

ROBOT_FRAMES = (BASE_FRAME, "base_footprint", "base")
"""The usual names of the robot's frame (REP 105), in order of preference."""

LASER_WORDS = re.compile(r"laser|lidar|scan|hokuyo|sick|velodyne|ouster|pandar|livox|(^|_)l[d|s]\d|urg|utm", re.I)
"""What names of frames of scanners contain."""

OTHER_WORDS = re.compile(r"imu|gps|gnss|cam|wheel|caster|optical|depth|rgb|sonar|cliff|bumper|compass|antenna", re.I)
"""What names of frames contain that are no scanner's."""


class LaserMounts(NamedTuple):
    """The laser's pose on the robot at M query stamps.

    Attributes:
        poses: (M, 3) x, y (m), heading (rad).
        upside_down: Whether the laser is mounted upside down (M,).
        notes: What was assumed.
        assumed: Whether a laser is only taken to be at the robot's origin: its mount is not in the log.
    """

    poses: FloatArray
    upside_down: NDArray[np.bool_]
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
        self.offset = laser_offset
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

    def scanner_frame(self, frame: str) -> tuple[str, tuple[str, ...]]:
        """Return the frame of a scanner whose own is not in the tf tree: the only one there that can be a scanner's.

        Args:
            frame: The frame that the scans name; may be empty.

        Returns:
            The frame, and a note where it is another one.
        """
        name = frame.lstrip("/")
        tree = self.tree
        if name in tree.edges or name in tree.parents:
            return name, ()
        leaves = [child for child in tree.edges if child not in tree.parents and tree.edges[child][1].static]
        likely = [leaf for leaf in leaves if LASER_WORDS.search(leaf)]
        possible = likely or [
            leaf for leaf in leaves if not OTHER_WORDS.search(leaf) and leaf.rpartition("/")[2] not in ROBOT_FRAMES
        ]
        if len(possible) != 1:
            return name, ()
        unknown = f"tf does not have the scans' frame {name}" if name else "the scans name no frame"
        return possible[0], (f"{unknown}: they are taken to be in {possible[0]}, which alone can be a scanner's",)

    def robot_frame(self, scanner: str) -> str | None:
        """Return the robot's frame in tf: one that moves in a fixed frame; None where there is none, or several.

        Args:
            scanner: The frame of a scanner. Of several robots it is on the one whose frames begin with the same name.

        Returns:
            The frame.
        """
        tree = self.tree
        moving = [child for child in tree.edges if len(self.fixed_chain(child)) > 1]
        named = [frame for frame in ROBOT_FRAMES if frame in moving]
        driven = [child for child in moving if not tree.edges[child][1].static and child not in FIXED_FRAMES]
        first = [child for child in driven if not {*tree.chain(child)[1:]} & {*driven}]
        if len(first) > 1 and not named:
            robot = scanner.lstrip("/").rpartition("/")[0]
            first = [child for child in first if robot and child.startswith(f"{robot}/")]
        return named[0] if named else first[0] if len(first) == 1 else None

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
            scans: When poses are asked for, and the lasers' frames.
            base: The robot's frame; empty where nothing names it: BASE_FRAME, or what all static transforms from the
                laser lead to.

        Returns:
            Its poses, and what was assumed.

        Raises:
            UsageError: One offset is given for several lasers.
        """
        self.check_offset(scans)
        stamps = scans.query_stamps
        poses, upside_down = np.zeros((len(stamps), 3)), np.zeros(len(stamps), dtype=bool)
        notes: tuple[str, ...] = ()
        assumed = False
        base = base or self._base_of(scans.frame_ids[0])
        for k, name in enumerate(scans.frame_ids):
            rows = scans.query_rows(k)
            frame, renamed = self._mounted_frame(name, base)
            tree, chain = self._chain_to(base, frame)
            rotation, translation, _ = tree.lookup(chain, stamps[rows])
            planar = project_to_plane(rotation, translation, self._min_upright)
            poses[rows], upside_down[rows] = planar[:2]
            notes += renamed + planar[2] + tree.contradictions(chain)
            if self.offset is not None:
                poses[rows] = self.offset.x, self.offset.y, self.offset.theta
                notes += (f"--laser-offset stands in for the transform from {base} to {frame}",) * (len(chain) > 1)
            elif frame != base and len(chain) == 1:
                assumed = True
                notes += (assumed_note(base, frame),)
        return LaserMounts(poses, upside_down, notes + self.tree_notes, assumed)

    def _base_of(self, frame: str) -> str:
        """Return the frame of the robot that carries a laser, by static transforms."""
        chain = self._static_tree.chain(frame)
        return BASE_FRAME if BASE_FRAME in chain or len(chain) == 1 else chain[-1]

    def check_offset(self, scans: ScanTimes) -> None:
        """Check that an offset that is given is that of one laser. Raises UsageError."""
        if self.offset is not None and len(scans.frame_ids) > 1:
            raise UsageError(
                f"--laser-offset goes with one scanner: give --scan-topic {shlex.quote(scans.topics[0])}"
            )

    def _mounted_frame(self, name: str, base: str) -> tuple[str, tuple[str, ...]]:
        """Return a scanner's frame; where tf has no chain from it to the robot, the one that alone can be it."""
        frame = name.lstrip("/")
        if frame == base or len(self._chain_to(base, frame)[1]) > 1:
            return frame, ()
        other, note = self.scanner_frame(frame)
        return (other, note) if len(self._chain_to(base, other)[1]) > 1 else (frame, ())

    def _chain_to(self, base: str, frame: str) -> tuple[TransformTree, list[str]]:
        """Return the frames from ``frame`` up to ``base``, and the tree that has them; else the frame alone."""
        for tree in (self._static_tree, self.tree):
            chain = tree.chain(frame)
            if base in chain:
                return tree, chain[: chain.index(base) + 1]
        return self.tree, chain[:1]


def assumed_note(base: str, frame: str) -> str:
    """Describe that a laser is taken to be at the robot's origin.

    Args:
        base: The robot's frame.
        frame: The laser's frame; empty where the scans name none.

    Returns:
        The note.
    """
    return (
        f"no transform from {base} to {frame or 'the scans, which name no frame'}: the laser is taken to be "
        "at the robot's origin; if it is not, give --laser-offset X Y DEG"
    )
