"""The tf tree of a log: transforms between frames over time, chains of them, and their projection to the plane."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.log.decoding.codecs import Content
from prim.log.decoding.values import StampedPose, planar_pose
from prim.log.messages import MAP_FRAME, ODOM_FRAME
from prim.log.source import LogSource, Topic
from prim.se2 import MAX_COORDINATE, wrap_angles

FIXED_FRAMES = (MAP_FRAME, ODOM_FRAME)
"""Frames that do not move (REP 105), in order of preference."""

STATIC_SUFFIX = "tf_static"
"""Topics whose names end so hold static transforms."""


@dataclass(frozen=True)
class TransformSeries:
    """A frame's 3D pose in its parent over time.

    Attributes:
        stamps: (N,) ns, strictly rising.
        translations: (N, 3) m.
        rotations: Unit quaternions (N, 4) as x, y, z, w.
        static: Whether the transform holds at all times.
    """

    stamps: Stamps
    translations: FloatArray
    rotations: FloatArray
    static: bool

    def interpolate(self, stamps: Stamps) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Interpolate translations linearly and rotations along the shortest arc (slerp) at ``stamps`` (M,) in ns.

        Returns rotation matrices (M, 3, 3), translations (M, 3) in m, and which stamps (M,) lie within the series.
        """
        after = np.clip(np.searchsorted(self.stamps, stamps), 0, len(self.stamps) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(self.stamps[after] - self.stamps[before], 1)
        share = np.clip((stamps - self.stamps[before]) / span, 0.0, 1.0)[:, None]
        translations = (1 - share) * self.translations[before] + share * self.translations[after]
        rotations = _slerp(self.rotations[before], self.rotations[after], share)
        within = (stamps >= self.stamps[0]) & (stamps <= self.stamps[-1]) | self.static
        return _rotation_matrices(rotations), translations, within


@dataclass(frozen=True)
class TransformOptions:
    """When transforms contradict each other; set by hand."""

    min_distance: float = 0.02
    """Transforms that lie closer together (m, with the turn as an arc at ``arm``) do not."""

    arm: float = 0.5
    """A turn counts as the arc at this distance (m)."""

    max_return: float = 0.2
    """Two publishers alternate: the next transform but one is nearer than the next by this factor."""

    min_share: float = 0.15
    """They do so for at least this share of the transforms."""

    rare_share: float = 0.02
    """Or for this share, always by the same distance, where one of them publishes seldom."""

    max_variation: float = 0.2
    """Distances whose standard deviation is this share of their median are the same."""

    min_jumps: int = 5
    """Fewer such jumps may be chance."""


DEFAULTS = TransformOptions()


class Disagreement(NamedTuple):
    """By how much transforms of one frame in another contradict each other.

    Attributes:
        distance: The median distance (m).
        turn: The median difference of the headings (rad).
        static: Whether the transforms hold at all times.
    """

    distance: float
    turn: float
    static: bool

    def note(self, parent: str, child: str) -> str:
        """Describe it.

        Args:
            parent: The frame that the transforms lead to.
            child: The frame that they lead from.

        Returns:
            The note.
        """
        by = f"{self.distance:.3f} m and {math.degrees(self.turn):.1f} degrees"
        if self.static:
            return f"static transforms from {parent} to {child} contradict each other by {by}: the last is used"
        return f"two publishers contradict each other on tf from {parent} to {child}, by {by}: both are used in turn"


@dataclass
class TransformTree:
    """The tf tree of a log.

    Attributes:
        edges: By each frame its parent, and its pose there over time.
        conflicts: Frames that have several parents, each with the parent that is used.
        disagreements: Frames whose transforms to their parent contradict each other, and by how much.
    """

    edges: dict[str, tuple[str, TransformSeries]] = field(default_factory=dict)
    conflicts: list[tuple[str, str]] = field(default_factory=list)
    disagreements: dict[str, Disagreement] = field(default_factory=dict)

    @classmethod
    def read(cls, log: LogSource, static_only: bool = False) -> TransformTree:
        """Read the transforms of a log.

        Args:
            log: The log.
            static_only: Read the topics of static transforms alone.

        Returns:
            The tree; an empty one where the log has no transforms.

        Raises:
            LogReadError: A message is missing, damaged, or cannot be decoded.
        """
        topics = log.holding(Content.TRANSFORMS)
        return cls._read(log, [topic for topic in topics if not static_only or topic.name.endswith(STATIC_SUFFIX)])

    @classmethod
    def read_topic(cls, log: LogSource, topic: Topic) -> TransformTree:
        """Read the transforms of one topic.

        Args:
            log: The log.
            topic: A topic of transforms.

        Returns:
            The tree.

        Raises:
            LogReadError: A message is missing, damaged, or cannot be decoded.
        """
        return cls._read(log, [topic])

    @classmethod
    def _read(cls, log: LogSource, topics: Sequence[Topic]) -> TransformTree:
        found: dict[tuple[str, str], list[StampedPose]] = defaultdict(list)
        static: set[tuple[str, str]] = set()
        for topic in topics:
            for _, poses in log.decoded(topic):
                for pose in poses:
                    edge = pose.frame_id.lstrip("/"), pose.child_frame_id.lstrip("/")
                    found[edge].append(pose)
                    if topic.name.endswith(STATIC_SUFFIX):
                        static.add(edge)
        tree = cls()
        usable = {edge: valid for edge, poses in found.items() if (valid := [p for p in poses if is_valid_pose(p)])}
        parents = Counter(child for _, child in usable)
        # of several parents the last one stays: map or odom, else the one with the most transforms
        for edge, poses in sorted(usable.items(), key=lambda item: (item[0][0] in FIXED_FRAMES, len(item[1]))):
            is_static = edge in static or len(poses) == 1
            tree.edges[edge[1]] = edge[0], _series(poses, is_static)
            if (found_disagreement := _disagreement(poses, is_static)) is not None:
                tree.disagreements[edge[1]] = found_disagreement
        tree.conflicts = [(child, tree.edges[child][0]) for child, count in parents.items() if count > 1]
        return tree

    @property
    def parents(self) -> set[str]:
        """The frames that are parents of others."""
        return {parent for parent, _ in self.edges.values()}

    def contradictions(self, chain: Sequence[str]) -> tuple[str, ...]:
        """Return notes of the transforms in a chain that contradict each other."""
        return tuple(
            self.disagreements[frame].note(self.edges[frame][0], frame)
            for frame in chain[:-1]
            if frame in self.disagreements
        )

    def chain(self, frame: str) -> list[str]:
        """Return the frames from ``frame`` up to its root, both included."""
        chain = [frame.lstrip("/")]
        while chain[-1] in self.edges and self.edges[chain[-1]][0] not in chain:
            chain.append(self.edges[chain[-1]][0])
        return chain

    def lookup(self, chain: Sequence[str], stamps: Stamps) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Compute the pose of a chain's first frame in its last.

        Args:
            chain: Frames, each followed by its parent.
            stamps: (N,) ns.

        Returns:
            Rotation matrices (N, 3, 3), translations (N, 3) in m, and at which stamps (N,) all transforms are known.
        """
        rotation = np.broadcast_to(np.eye(3), (len(stamps), 3, 3))
        translation = np.zeros((len(stamps), 3))
        valid = np.ones(len(stamps), dtype=bool)
        for frame in chain[:-1]:
            turn, shift, within = self.edges[frame][1].interpolate(stamps)
            rotation = turn @ rotation
            translation = np.einsum("nij,nj->ni", turn, translation) + shift
            valid &= within
        return rotation, translation, valid


def is_valid_pose(pose: StampedPose) -> bool:
    """Return whether a pose lies within MAX_COORDINATE and its quaternion is near unit norm, by a factor of 1000."""
    within = all(abs(coordinate) <= MAX_COORDINATE for coordinate in pose.translation)  # False for NaN
    return within and 1e-3 < math.hypot(*pose.rotation) < 1e3


def project_to_plane(
    rotation: FloatArray, translation: FloatArray, min_upright: float
) -> tuple[FloatArray, bool, tuple[str, ...]]:
    """Project 3D poses of a laser to the horizontal plane.

    Args:
        rotation: Rotation matrices (N, 3, 3).
        translation: Translations (N, 3) in m.
        min_upright: A laser whose axis has a smaller cosine to the vertical is reported as tilted.

    Returns:
        Poses (N, 3) as x, y (m) and heading of the x axis (rad), whether the laser is upside down, and notes.
    """
    heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    up = np.median(rotation[:, 2, 2])
    notes: tuple[str, ...] = ()
    if abs(up) < min_upright:
        tilt = np.degrees(np.arccos(min(abs(up), 1.0)))
        notes = (f"the laser is tilted by {tilt:.0f} degrees: the map shows its plane, not the floor plan",)
    return np.column_stack((translation[:, :2], heading)), bool(up < 0), notes


def _series(poses: Sequence[StampedPose], static: bool) -> TransformSeries:
    """Sort transforms by stamp; of several with one stamp the last remains, of static ones the last alone."""
    if static:
        poses = poses[-1:]
    by_stamp = {pose.stamp: pose for pose in sorted(poses, key=lambda pose: pose.stamp)}
    rotations = np.array([pose.rotation for pose in by_stamp.values()])
    return TransformSeries(
        np.array(list(by_stamp), dtype=np.int64),
        np.array([pose.translation for pose in by_stamp.values()]),
        rotations / np.linalg.norm(rotations, axis=1, keepdims=True),
        static,
    )


def _disagreement(
    poses: Sequence[StampedPose], static: bool, options: TransformOptions = DEFAULTS
) -> Disagreement | None:
    """Find out whether transforms contradict each other: static ones that differ, or others that jump to and fro."""
    if len(poses) < (2 if static else 3):
        return None
    planar = np.array([_planar(pose) for pose in sorted(poses, key=lambda pose: pose.stamp)])
    ahead = 1 if static else 2
    first = planar[:-ahead]
    steps, turns = _apart(planar[1:][: len(first)], first)
    length = steps + options.arm * turns
    jumps = length > options.min_distance
    if not static:
        back_steps, back_turns = _apart(planar[2:], first)
        jumps &= back_steps + options.arm * back_turns <= options.max_return * length
    if not jumps.any() or (not static and not _is_another_publisher(jumps, length, options)):
        return None
    return Disagreement(float(np.median(steps[jumps])), float(np.median(turns[jumps])), static)


def _is_another_publisher(jumps: NDArray[np.bool_], length: FloatArray, options: TransformOptions) -> bool:
    """Return whether jumps (N,) there and back are so many, or so much alike, that no noise makes them."""
    if jumps.mean() >= options.min_share:
        return True
    found = length[jumps]
    alike = float(found.std()) <= options.max_variation * float(np.median(found))
    return jumps.mean() >= options.rare_share and len(found) >= options.min_jumps and alike


def _planar(pose: StampedPose) -> tuple[float, float, float]:
    norm = math.hypot(*pose.rotation)
    x, y, z, w = (value / norm for value in pose.rotation)
    plane = planar_pose(pose._replace(rotation=(x, y, z, w)))
    return plane.x, plane.y, plane.theta


def _apart(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distances (N,) in m and the differences of headings (N,) in rad of planar poses (N, 3)."""
    return np.hypot(a[:, 0] - b[:, 0], a[:, 1] - b[:, 1]), np.abs(wrap_angles(a[:, 2] - b[:, 2]))


def _slerp(a: FloatArray, b: FloatArray, share: FloatArray) -> FloatArray:
    """Return unit quaternions (N, 4) at ``share`` (N, 1) of the shorter arc from a to b (Shoemake, 1985)."""
    cosine = np.einsum("ni,ni->n", a, b)[:, None]
    b = np.where(cosine < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    near = sine < 1e-9
    safe = np.where(near, 1.0, sine)
    first = np.where(near, 1 - share, np.sin((1 - share) * angle) / safe)
    second = np.where(near, share, np.sin(share * angle) / safe)
    return first * a + second * b


def _rotation_matrices(quaternions: FloatArray) -> FloatArray:
    """Return the rotation matrices (N, 3, 3) of unit quaternions (N, 4) as x, y, z, w."""
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
