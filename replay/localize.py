"""Where the laser was at every scan: poses from the ground truth, the tf tree, odometry, or standing still."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

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
    POSE_DECODERS,
    POSE_TYPE,
    POSE_WITH_COVARIANCE_TYPE,
    TF_TYPE,
    TRUE_POSE_TOPIC,
    StampedPose,
    decode_poses,
    planar,
)
from prim.raycast import FloatArray

SOURCES = ("auto", "truth", "tf", "odom")
STILL = "still"

ROOTS = (MAP_FRAME, ODOM_FRAME)
"""Frames that stand still, the best first."""

MAX_GAP = 1.0
"""Poses further apart (s) than this are interpolated over a gap, which is said."""

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
    disputed: list[tuple[str, str]] = field(default_factory=list)

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
        usable = {edge: kept for edge, poses in found.items() if (kept := [p for p in poses if _usable(p)])}
        parents = Counter(child for _, child in usable)
        # of several parents the last one stays: map or odom, else the one with the most transforms
        for edge, poses in sorted(usable.items(), key=lambda item: (item[0][0] in ROOTS, len(item[1]))):
            tree.edges[edge[1]] = edge[0], _transforms(poses, edge in static or len(poses) == 1)
        tree.disputed = [(child, tree.edges[child][0]) for child, count in parents.items() if count > 1]
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
        self._tree_notes: tuple[str, ...] = ()

    @cached_property
    def _tree(self) -> TransformTree:
        """The log's tf tree; an empty one, and a note, where it cannot be read."""
        try:
            return TransformTree.read(self._log)
        except LogReadError as error:
            self._tree_notes = (f"tf is not used: {error.what}",)
            return TransformTree()

    def locate(self, scans: ScanTimes, source: str = "auto") -> LaserPoses:
        """The laser's pose at every scan, from ``source`` or, with ``auto``, from the best there is.

        That is the ground truth, else a tf chain to ``map``, else any tf chain, else odometry.
        """
        found = self._find(scans, source)
        if not found.valid.any():
            raise LogReadError(self._log.path, *self._no_overlap(scans, found))
        return found

    def _find(self, scans: ScanTimes, source: str) -> LaserPoses:
        if source == "auto" and self._odom_topic is not None:
            source = "odom"
        if source == "truth" or (source == "auto" and self.has_truth):
            return self._from_truth(scans)
        if source == "odom":
            return self._from_odometry(scans, source)
        chain = self._fixed_chain(scans.frame_id)
        if source == "tf" or len(chain) > 1:
            return self._from_tf(scans, chain)
        return self._from_odometry(scans, source)

    @property
    def has_truth(self) -> bool:
        """Whether the log has true poses."""
        topic = self._log.topics.get(TRUE_POSE_TOPIC)
        return topic is not None and topic.messages > 0 and topic.type == POSE_TYPE

    def _from_truth(self, scans: ScanTimes) -> LaserPoses:
        if not self.has_truth:
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
                "; ".join(
                    [*self._tree_notes, *self._log.lost, "to map with the robot at rest give --standing-still"]
                ),
            )
        return self._from_topic(scans, topic, "odom")

    def _odometry_topic(self) -> Topic | None:
        """The one topic of poses, or the one asked for."""
        topics = [t for t in self._pose_topics() if t.name != TRUE_POSE_TOPIC or t.name == self._odom_topic]
        names = ", ".join(f"{topic.name} ({topic.type})" for topic in topics) or "none"
        if self._odom_topic is not None:
            chosen = [topic for topic in topics if topic.name == self._odom_topic]
            if not chosen:
                there = self._log.topics.get(self._odom_topic)
                what = f"no {'messages' if there and there.type in POSE_DECODERS else 'poses'} on {self._odom_topic}"
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
        trajectory = Trajectory.from_unsorted(stamps, poses)
        at, valid = trajectory.at(scans.stamps)
        mounts, upside_down, notes = self._mount(scans, base or BASE_FRAME)
        notes += _gap_note(topic.name, trajectory.stamps, scans.stamps)
        if unusable:
            notes += (f"{topic.name}: {unusable} poses that are not finite or have no rotation were skipped",)
        return LaserPoses(source, topic.name, _compose(at, mounts), valid, upside_down, notes)

    def stand_still(self, scans: ScanTimes) -> LaserPoses:
        """A robot at the map's origin all the time, its laser where the offset or tf puts it."""
        mounts, upside_down, _ = self._mount(scans, BASE_FRAME)
        valid = np.ones(len(scans.stamps), dtype=bool)
        return LaserPoses(STILL, "standing still", mounts, valid, upside_down)

    def _mount(self, scans: ScanTimes, base: str) -> tuple[FloatArray, bool, tuple[str, ...]]:
        """Where the laser stands on the robot at every scan, whether upside down, and what had to be assumed."""
        frame = scans.frame_id.lstrip("/")
        chain = self._tree.chain(frame)
        chain = chain[: chain.index(base) + 1] if base in chain else chain[:1]
        rotation, translation, _ = self._tree.lookup(chain, scans.stamps)
        mounts, upside_down, notes = _flatten(rotation, translation)
        notes += self._tree_notes
        if self._offset is not None:
            mounts[:] = self._offset.x, self._offset.y, self._offset.theta
            notes += (f"--laser-offset stands in for the transform from {base} to {frame}",) * (len(chain) > 1)
        elif frame != base and len(chain) == 1:
            notes += (
                f"no transform from {base} to {frame or 'the scans, which name no frame'}: the laser is taken to be "
                "at the robot's origin; if it is not, give --laser-offset X Y DEG",
            )
        return mounts, upside_down, notes

    def _fixed_chain(self, frame: str) -> list[str]:
        """The tf chain from ``frame`` to ``map``, else ``odom``, else its moving root; the frame alone if none."""
        chain = self._tree.chain(frame)
        for root in ROOTS:
            if root in chain:
                return chain[: chain.index(root) + 1]
        moving = any(not self._tree.edges[link][1].static for link in chain[:-1])
        return chain if moving else chain[:1]

    def _from_tf(self, scans: ScanTimes, chain: list[str]) -> LaserPoses:
        if len(chain) < 2 and self._tree_notes:
            raise LogReadError(self._log.path, *self._tree_notes)
        if len(chain) < 2:
            frames = ", ".join(sorted({*self._tree.edges, *(parent for parent, _ in self._tree.edges.values())}))
            raise LogReadError(
                self._log.path,
                f"tf has no chain from {scans.frame_id!r} to a fixed frame (its frames: {frames or 'none'})",
                "give another --pose",
            )
        rotation, translation, valid = self._tree.lookup(chain, scans.stamps)
        poses, upside_down, notes = _flatten(rotation, translation)
        for frame in chain[:-1]:
            parent, edge = self._tree.edges[frame]
            if not edge.static:
                notes += _gap_note(f"tf from {parent} to {frame}", edge.stamps, scans.stamps)
        notes += tuple(
            f"{frame} has several parents in tf: {parent} is used" for frame, parent in self._tree.disputed
        )
        if self._offset is not None:
            notes += ("--laser-offset is not used: tf says where the laser is",)
        return LaserPoses("tf", " > ".join(reversed(chain)), poses, valid, upside_down, notes)

    def _no_overlap(self, scans: ScanTimes, found: LaserPoses) -> tuple[str, str]:
        first, last = scans.stamps.min() / 1e9, scans.stamps.max() / 1e9
        what = f"no scan (stamps {first:.3f} to {last:.3f} s) lies within the time of the poses on {found.origin}"
        return what, "two clocks in one log? give another --pose or --odom-topic"


def _gap_note(what: str, poses: Stamps, scans: Stamps) -> tuple[str, ...]:
    """A note where scans (stamps in ns) lie between poses that are far apart in time."""
    after = np.clip(np.searchsorted(poses, scans), 1, max(len(poses) - 1, 1))
    if len(poses) < 2:
        return ()
    inside = (scans > poses[after - 1]) & (scans < poses[after])
    gaps = np.where(inside, poses[after] - poses[after - 1], 0) / 1e9
    wide = int(np.count_nonzero(gaps > MAX_GAP))
    if not wide:
        return ()
    scans_lie = "1 scan lies" if wide == 1 else f"{wide} scans lie"
    return (f"{what}: {scans_lie} in a gap of up to {gaps.max():.1f} s between poses, and are placed in between",)


def _compose(poses: FloatArray, mounts: FloatArray) -> FloatArray:
    """Poses (N, 3) of frames that are mounted at ``mounts`` (N, 3) on frames at ``poses`` (N, 3)."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cos * mounts[:, 0] - sin * mounts[:, 1]
    y = poses[:, 1] + sin * mounts[:, 0] + cos * mounts[:, 1]
    return np.column_stack((x, y, poses[:, 2] + mounts[:, 2]))


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
    by_stamp = {pose.stamp: pose for pose in sorted(poses, key=lambda pose: pose.stamp)}
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
