"""The tf tree of a log: transforms between frames over time, and how a chain of them looks from above."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.log.mcap import LogReader
from prim.log.messages import MAP_FRAME, ODOM_FRAME, TF_TYPE, StampedPose, decode_poses
from replay.poses.sensors import is_usable

ROOTS = (MAP_FRAME, ODOM_FRAME)
"""Frames that stand still, the best first."""

STATIC = "tf_static"
"""Topics whose names end so hold transforms that stay."""

MAX_TILT = 0.97
"""Below this cosine a laser's plane counts as tilted, and its scans as no horizontal section (14 degrees)."""


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
    def read(cls, log: LogReader, static_only: bool = False) -> TransformTree:
        """Reads all topics of tf messages, or those of static ones alone. Raises LogReadError."""
        found: dict[tuple[str, str], list[StampedPose]] = defaultdict(list)
        static: set[tuple[str, str]] = set()
        for topic in log.of_type(TF_TYPE):
            if static_only and not topic.name.endswith(STATIC):
                continue
            for _, poses in log.decoded(topic, partial(decode_poses, TF_TYPE)):
                for pose in poses:
                    edge = pose.frame_id.lstrip("/"), pose.child_frame_id.lstrip("/")
                    found[edge].append(pose)
                    if topic.name.endswith(STATIC):
                        static.add(edge)
        tree = cls()
        usable = {edge: kept for edge, poses in found.items() if (kept := [p for p in poses if is_usable(p)])}
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


def flatten(rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, bool, tuple[str, ...]]:
    """3D poses seen from above: x, y, heading of the x axis (N, 3); upside down or not; notes."""
    heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    up = np.median(rotation[:, 2, 2])
    notes: tuple[str, ...] = ()
    if abs(up) < MAX_TILT:
        tilt = np.degrees(np.arccos(min(abs(up), 1.0)))
        notes = (f"the laser is tilted by {tilt:.0f} degrees: the map shows its plane, not the floor plan",)
    return np.column_stack((translation[:, :2], heading)), bool(up < 0), notes


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
