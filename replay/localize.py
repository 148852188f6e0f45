"""Where the laser was at every scan: poses from the ground truth, the tf tree, odometry, or standing still."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from prim.errors import LogReadError
from prim.frames import Pose2D, Stamps, Trajectory
from prim.log import LogReader, Topic
from prim.messages import (
    BASE_FRAME,
    MAP_FRAME,
    ODOM_FRAME,
    ODOMETRY_TYPE,
    POSE_TYPE,
    POSE_WITH_COVARIANCE_TYPE,
    TF_TYPE,
    TRUE_POSE_TOPIC,
    StampedPose,
    decode_poses,
    planar,
)
from prim.shapes import FloatArray

SOURCES = ("auto", "truth", "tf", "odom")
STILL = "still"

MAX_TILT = 0.97
"""Below this cosine a laser's plane counts as tilted, and its scans as no horizontal section (14 degrees)."""


@dataclass(frozen=True)
class LaserPoses:
    """The laser's pose at each of N scans.

    ``poses`` (N, 3) are x, y (m), theta (rad) in the map frame; ``valid`` (N,) marks the scans within the time
    of the poses. ``upside_down`` lasers turn the other way. ``source`` is one of SOURCES or STILL, ``origin``
    says it in full, ``notes`` what was assumed.
    """

    source: str
    origin: str
    poses: FloatArray
    valid: NDArray[np.bool_]
    upside_down: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScanTimes:
    """The scans to find poses for: their stamps (N,) in ns and the frame they are given in."""

    stamps: Stamps
    frame_id: str


@dataclass(frozen=True)
class Transforms:
    """3D transforms over time: ``stamps`` (N,), ``translations`` (N, 3), ``rotations`` (N, 4) as x, y, z, w."""

    stamps: Stamps
    translations: FloatArray
    rotations: FloatArray
    static: bool

    def at(self, stamps: Stamps) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Rotation matrices (M, 3, 3), translations (M, 3), and which stamps lie within the transforms' time.

        In between, translations are interpolated linearly and rotations along the shortest arc.
        """
        after = np.clip(np.searchsorted(self.stamps, stamps), 0, len(self.stamps) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(self.stamps[after] - self.stamps[before], 1)
        share = np.clip((stamps - self.stamps[before]) / span, 0.0, 1.0)[:, None]
        translations = (1 - share) * self.translations[before] + share * self.translations[after]
        rotations = _slerp(self.rotations[before], self.rotations[after], share)
        within = (stamps >= self.stamps[0]) & (stamps <= self.stamps[-1]) | self.static
        return _matrices(rotations), translations, within


@dataclass
class TransformTree:
    """The tf tree of a log: each frame's parent and where the frame stands in it over time."""

    edges: dict[str, tuple[str, Transforms]] = field(default_factory=dict)

    @classmethod
    def read(cls, log: LogReader) -> TransformTree:
        """Reads all topics of tf messages. Raises LogReadError."""
        found: dict[tuple[str, str], list[StampedPose]] = defaultdict(list)
        static: set[tuple[str, str]] = set()
        for topic in log.of_type(TF_TYPE):
            for _, poses in log.decoded(topic, partial(decode_poses, TF_TYPE)):
                for pose in poses:
                    edge = pose.frame_id.lstrip("/"), pose.child_frame_id.lstrip("/")
                    found[edge].append(pose)
                    if topic.name.endswith("tf_static"):
                        static.add(edge)
        tree = cls()
        for edge, poses in sorted(found.items(), key=lambda item: len(item[1])):
            usable = [pose for pose in poses if _usable(pose)]
            if usable:  # of two parents, the one with more transforms comes last and stays
                tree.edges[edge[1]] = edge[0], _transforms(usable, edge in static or len(usable) == 1)
        return tree

    def chain(self, frame: str) -> list[str]:
        """The frames from ``frame`` up to its root, both included."""
        chain = [frame.lstrip("/")]
        while chain[-1] in self.edges and self.edges[chain[-1]][0] not in chain:
            chain.append(self.edges[chain[-1]][0])
        return chain

    def lookup(self, chain: Sequence[str], stamps: Stamps) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Rotations, translations and validity of the chain's first frame in its last, at ``stamps``."""
        rotation = np.broadcast_to(np.eye(3), (len(stamps), 3, 3))
        translation = np.zeros((len(stamps), 3))
        valid = np.ones(len(stamps), dtype=bool)
        for frame in chain[:-1]:
            turn, shift, within = self.edges[frame][1].at(stamps)
            rotation = turn @ rotation
            translation = np.einsum("nij,nj->ni", turn, translation) + shift
            valid &= within
        return rotation, translation, valid


class Localizer:
    """Finds the laser's poses in a log by the source asked for. Raises LogReadError, naming what is there."""

    def __init__(self, log: LogReader, odom_topic: str | None = None, laser_offset: Pose2D | None = None) -> None:
        self._log = log
        self._odom_topic = odom_topic
        self._offset = laser_offset
        self._tree = TransformTree.read(log)

    def locate(self, scans: ScanTimes, source: str = "auto") -> LaserPoses:
        """The laser's pose at every scan, from ``source`` or, with ``auto``, from the best there is.

        That is the ground truth, else a tf chain to ``map``, else any tf chain, else odometry.
        """
        found = self._find(scans, source)
        if not found.valid.any():
            raise LogReadError(self._log.path, *self._no_overlap(scans, found))
        return found

    def _find(self, scans: ScanTimes, source: str) -> LaserPoses:
        if source == "truth" or (source == "auto" and self._has(TRUE_POSE_TOPIC)):
            return self._from_truth(scans)
        chain = self._fixed_chain(scans.frame_id)
        if source == "tf" or (source == "auto" and len(chain) > 1 and not self._odom_topic):
            return self._from_tf(scans, chain)
        return self._from_odometry(scans, source)

    def _has(self, topic: str) -> bool:
        return topic in self._log.topics and self._log.topics[topic].messages > 0

    def _from_truth(self, scans: ScanTimes) -> LaserPoses:
        if not self._has(TRUE_POSE_TOPIC):
            raise LogReadError(
                self._log.path, f"no ground truth: there is no {TRUE_POSE_TOPIC}", "give another --pose"
            )
        return self._from_topic(scans, self._log.topics[TRUE_POSE_TOPIC], "truth")

    def _from_odometry(self, scans: ScanTimes, source: str) -> LaserPoses:
        topic = self._odometry_topic()
        if topic is None:
            everything = "no ground truth, no tf chain, " if source == "auto" else ""
            raise LogReadError(
                self._log.path,
                f"no poses for frame {scans.frame_id!r}: {everything}no Odometry or PoseStamped",
                "to map it with the robot at rest give --standing-still",
            )
        return self._from_topic(scans, topic, "odom")

    def _odometry_topic(self) -> Topic | None:
        """The one topic of poses, or the one asked for."""
        topics = [t for t in self._pose_topics() if t.name != TRUE_POSE_TOPIC or t.name == self._odom_topic]
        names = ", ".join(f"{topic.name} ({topic.type})" for topic in topics) or "none"
        if self._odom_topic is not None:
            chosen = [topic for topic in topics if topic.name == self._odom_topic]
            if not chosen:
                what = f"no poses on {self._odom_topic}"
                raise LogReadError(self._log.path, what, f"topics with poses: {names}")
            return chosen[0]
        odometry = [topic for topic in topics if topic.type == ODOMETRY_TYPE] or topics
        if len(odometry) > 1:
            what = f"poses on {len(odometry)} topics: {', '.join(topic.name for topic in odometry)}"
            raise LogReadError(self._log.path, what, "choose one with --odom-topic")
        return odometry[0] if odometry else None

    def _pose_topics(self) -> list[Topic]:
        return self._log.of_type(ODOMETRY_TYPE, POSE_TYPE, POSE_WITH_COVARIANCE_TYPE)

    def _from_topic(self, scans: ScanTimes, topic: Topic, source: str) -> LaserPoses:
        """The robot's poses on a topic, and the laser where it is mounted on the robot."""
        stamps: list[int] = []
        poses: list[tuple[float, float, float]] = []
        base = ""
        unusable = 0
        for _, messages in self._log.decoded(topic, partial(decode_poses, topic.type)):
            for message in messages:
                if _usable(message):
                    pose = planar(message)
                    stamps.append(message.stamp)
                    poses.append((pose.x, pose.y, pose.theta))
                    base = message.child_frame_id.lstrip("/")
                else:
                    unusable += 1
        if not stamps:
            raise LogReadError(self._log.path, f"{topic.name} has no usable pose", "give another --pose")
        at, valid = Trajectory.from_unsorted(stamps, poses).at(scans.stamps)
        mount, upside_down, notes = self._mount(scans, base or BASE_FRAME)
        if unusable:
            notes = (
                *notes,
                f"{topic.name}: {unusable} poses that are not finite or have no rotation were skipped",
            )
        return LaserPoses(source, topic.name, _compose(at, mount), valid, upside_down, notes)

    def _mount(self, scans: ScanTimes, base: str) -> tuple[Pose2D, bool, tuple[str, ...]]:
        """Where the laser stands on the robot, whether upside down, and what had to be assumed."""
        frame = scans.frame_id.lstrip("/")
        if self._offset is not None:
            return self._offset, False, ()
        if frame == base:
            return Pose2D(), False, ()
        chain = self._tree.chain(frame)
        if base not in chain:
            note = (
                f"no transform from {base} to {frame}: the laser is taken to be at the robot's origin; "
                "if it is not, give --laser-offset X Y DEG"
            )
            return Pose2D(), False, (note,)
        rotation, translation, _ = self._tree.lookup(chain[: chain.index(base) + 1], scans.stamps[:1])
        poses, upside_down, notes = _flatten(rotation, translation)
        return Pose2D(*poses[0].tolist()), upside_down, notes

    def _fixed_chain(self, frame: str) -> list[str]:
        """The tf chain from ``frame`` to ``map``, else ``odom``, else its moving root; the frame alone if none."""
        chain = self._tree.chain(frame)
        for root in (MAP_FRAME, ODOM_FRAME):
            if root in chain:
                return chain[: chain.index(root) + 1]
        moving = any(not self._tree.edges[link][1].static for link in chain[:-1])
        return chain if moving else chain[:1]

    def _from_tf(self, scans: ScanTimes, chain: list[str]) -> LaserPoses:
        if len(chain) < 2:
            frames = ", ".join(sorted({*self._tree.edges, *(parent for parent, _ in self._tree.edges.values())}))
            raise LogReadError(
                self._log.path,
                f"tf has no chain from {scans.frame_id!r} to a fixed frame (its frames: {frames or 'none'})",
                "give another --pose",
            )
        rotation, translation, valid = self._tree.lookup(chain, scans.stamps)
        poses, upside_down, notes = _flatten(rotation, translation)
        if self._offset is not None:
            note = "--laser-offset is not used: tf says where the laser is"
            notes = (*notes, note)
        return LaserPoses("tf", " > ".join(reversed(chain)), poses, valid, upside_down, notes)

    def _no_overlap(self, scans: ScanTimes, found: LaserPoses) -> tuple[str, str]:
        first, last = scans.stamps.min() / 1e9, scans.stamps.max() / 1e9
        what = f"no scan (stamps {first:.3f} to {last:.3f} s) lies within the time of the poses on {found.origin}"
        return what, "two clocks in one log? give another --pose or --odom-topic"


def standing_still(scans: ScanTimes, laser_offset: Pose2D | None) -> LaserPoses:
    """A robot at the map's origin all the time."""
    offset = laser_offset or Pose2D()
    poses = np.tile([offset.x, offset.y, offset.theta], (len(scans.stamps), 1))
    return LaserPoses(STILL, "standing still", poses, np.ones(len(scans.stamps), dtype=bool))


def _compose(poses: FloatArray, mount: Pose2D) -> FloatArray:
    """Poses (N, 3) of a frame that is mounted at ``mount`` on frames at ``poses``."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cos * mount.x - sin * mount.y
    y = poses[:, 1] + sin * mount.x + cos * mount.y
    return np.column_stack((x, y, poses[:, 2] + mount.theta))


def _flatten(rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, bool, tuple[str, ...]]:
    """3D poses seen from above: x, y, heading of the x axis (N, 3); upside down or not; notes."""
    heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    up = np.median(rotation[:, 2, 2])
    notes: tuple[str, ...] = ()
    if abs(up) < MAX_TILT:
        tilt = np.degrees(np.arccos(min(abs(up), 1.0)))
        notes = (f"the laser is tilted by {tilt:.0f} degrees: the map shows its plane, not the floor plan",)
    return np.column_stack((translation[:, :2], heading)), bool(up < 0), notes


def _usable(pose: StampedPose) -> bool:
    return bool(np.isfinite((*pose.translation, *pose.rotation)).all() and np.linalg.norm(pose.rotation) > 1e-3)


def _transforms(poses: Sequence[StampedPose], static: bool) -> Transforms:
    """Transforms sorted by stamp; of several with one stamp the last; of static ones the last alone."""
    if static:
        poses = poses[-1:]
    by_stamp = dict(sorted((pose.stamp, pose) for pose in poses))
    rotations = np.array([pose.rotation for pose in by_stamp.values()])
    return Transforms(
        np.array(list(by_stamp), dtype=np.int64),
        np.array([pose.translation for pose in by_stamp.values()]),
        rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        static,
    )


def _slerp(a: FloatArray, b: FloatArray, share: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4) at ``share`` (N, 1) of the shorter arc from a to b."""
    cosine = np.einsum("ni,ni->n", a, b)[:, None]
    b = np.where(cosine < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-9
    safe = np.where(near, 1.0, sine)
    first = np.where(near, 1 - share, np.sin((1 - share) * angle) / safe)
    second = np.where(near, share, np.sin(share * angle) / safe)
    return first * a + second * b


def _matrices(quaternions: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4) as x, y, z, w."""
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
