"""Where the laser was at every scan: poses from the ground truth, the tf tree, odometry, or standing still."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray, Stamps
from prim.errors import LogReadError
from prim.log.mcap import LogReader
from prim.log.messages import (
    BASE_FRAME,
    MAP_FRAME,
    ODOMETRY_TYPE,
    POSE_DECODERS,
    POSE_TYPE,
    POSE_WITH_COVARIANCE_TYPE,
    TRUE_POSE_TOPIC,
)
from prim.log.source import Topic
from prim.se2 import Pose2D
from replay.poses.fusion import Estimate, Fusion, Nodes, PoseNoise, nodes_at
from replay.poses.scan_times import ScanTimes
from replay.poses.sensors import Sensed, find_compass, find_gps, headings, read_odometry, read_sensors
from replay.poses.transforms import ROOTS, TransformTree, flatten

FUSED = "fused"
SOURCES = ("auto", "truth", "tf", "odom", FUSED)
STILL = "still"
ODOM, GPS, COMPASS = SENSORS = ("odom", "gps", "compass")
"""What poses are fused from."""


MAX_GAP = 1.0
"""Poses further apart (s) than this are interpolated over a gap, which is said."""

MANY_REJECTED = 0.02
"""Where a larger share of a sensor's readings is not used, it is said."""


@dataclass(frozen=True)
class LaserPoses:
    """The laser's pose at each of N scans.

    ``poses`` (N, 3) are x, y (m), theta (rad) in the map frame; ``valid`` (N,) marks the scans within the time
    of the poses; ``ends`` (N, 3) are the poses at each scan's last beam, where that is not taken with the first.
    ``upside_down`` lasers turn the other way. ``source`` is one of SOURCES or STILL, ``origin``
    says it in full, ``notes`` what was assumed. Fused poses have ``covariances`` (N, 3, 3), a ``frame_covariance``
    (3, 3) of the map's own place (see :meth:`.Estimate.frame_covariance`), ``sensors`` that say how
    noisy each was found to be, and the ``fusion`` itself, of a robot with the laser mounted at ``mounts`` (N, 3).
    Where scans were ``matched`` with the map, the poses are corrected by that.
    """

    source: str
    origin: str
    poses: FloatArray
    valid: NDArray[np.bool_]
    upside_down: bool = False
    notes: tuple[str, ...] = ()
    ends: FloatArray | None = None
    covariances: FloatArray | None = None
    frame_covariance: FloatArray | None = None
    sensors: tuple[Sensor, ...] = ()
    fusion: Fusion | None = None
    mounts: FloatArray | None = None
    matched: bool = False

    def at(self, position: int) -> Pose2D:
        """A scan's pose, with its covariance where that is known."""
        covariance = None if self.covariances is None else self.covariances[position]
        x, y, theta = self.poses[position].tolist()
        return Pose2D(x, y, theta, covariance)

    def end(self, position: int) -> Pose2D | None:
        """The pose at a scan's last beam; None where that is taken with the first."""
        return None if self.ends is None else Pose2D(*self.ends[position].tolist())


@dataclass(frozen=True)
class Sensor:
    """A sensor that poses were fused from: how many readings were used, and how many were too far off to be.

    ``std`` is its noise by name, in SI units, as far as it was given or found: ``m`` and ``rad``; the odometry's
    after one metre of way. ``bias`` (rad) is what a compass is off by all the time.
    """

    name: str
    topic: str
    used: int
    rejected: int
    std: Mapping[str, float]
    bias: float = 0.0


@dataclass(frozen=True)
class FuseOptions:
    """What ``fused`` poses are made of: which of SENSORS, on which topics, and what is known of their noise."""

    sensors: tuple[str, ...] = SENSORS
    gps_topic: str | None = None
    compass_topic: str | None = None
    noise: PoseNoise = field(default_factory=PoseNoise)


class Localizer:
    """Finds the laser's poses in a log by the source asked for. Raises LogReadError, naming what is there."""

    def __init__(
        self,
        log: LogReader,
        odom_topic: str | None = None,
        laser_offset: Pose2D | None = None,
        fuse: FuseOptions | None = None,
    ) -> None:
        self._log = log
        self._odom_topic = odom_topic
        self._offset = laser_offset
        self._fuse = fuse or FuseOptions()
        self._tree_notes: tuple[str, ...] = ()

    @cached_property
    def _tree(self) -> TransformTree:
        """The log's tf tree; an empty one, and a note, where it cannot be read."""
        try:
            return TransformTree.read(self._log)
        except LogReadError as error:
            self._tree_notes = (f"tf is not used: {error.what}",)
            return TransformTree()

    @cached_property
    def _static_tree(self) -> TransformTree:
        """The transforms that stay, which are read in no time; those alone, unless they are not enough."""
        try:
            return TransformTree.read(self._log, static_only=True)
        except LogReadError:
            return TransformTree()

    def _chain_to(self, base: str, frame: str) -> tuple[TransformTree, list[str]]:
        """The frames from ``frame`` up to ``base``, and the tree that has them; the frame alone where none does."""
        for tree in (self._static_tree, self._tree):
            chain = tree.chain(frame)
            if base in chain:
                return tree, chain[: chain.index(base) + 1]
        return self._tree, chain[:1]

    def locate(self, scans: ScanTimes, source: str = "auto") -> LaserPoses:
        """The laser's pose at every scan, from ``source`` or, with ``auto``, from the best there is.

        That is the ground truth, else a tf chain to ``map``, else what can be fused with a GPS or a compass, else any
        tf chain, else odometry.
        """
        found = _with_ends(self._find(scans, source), len(scans.stamps))
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
        if source == FUSED:
            return self._from_fusion(scans)
        chain = self._fixed_chain(scans.frame_id)
        reason: tuple[str, ...] = ()
        if source == "auto" and chain[-1] != MAP_FRAME:
            try:
                if self._can_fuse():
                    return self._from_fusion(scans)
            except LogReadError as error:
                if replace(self._fuse, noise=PoseNoise()) != FuseOptions():
                    raise
                reason = (f"nothing is fused: {error.what}",)
        found = (
            self._from_tf(scans, chain) if source == "tf" or len(chain) > 1 else self._from_odometry(scans, source)
        )
        return replace(found, notes=found.notes + reason)

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
        odometry = read_odometry(self._log, topic)
        at, valid = odometry.trajectory.at(scans.wanted)
        mounts, upside_down, notes = self._mount(scans, odometry.base or BASE_FRAME)
        notes += _gap_note(topic.name, odometry.trajectory.stamps, scans.stamps) + odometry.notes
        return LaserPoses(source, topic.name, compose(at, mounts), valid, upside_down, notes)

    def _can_fuse(self) -> bool:
        """Whether the log has a GPS or compass to fuse with, as far as ``auto`` is concerned."""
        try:
            odometry, gps, compass = self._sensor_topics()
        except LogReadError:
            return False
        return bool((odometry and (gps or compass)) or (gps and compass))

    def _sensor_topics(self) -> tuple[Topic | None, Topic | None, Topic | None]:
        """The topics of odometry, GPS and compass; None for those that are not there or not wanted."""
        fuse = self._fuse
        return (
            self._wheels() if ODOM in fuse.sensors else None,
            find_gps(self._log, fuse.gps_topic) if GPS in fuse.sensors else None,
            find_compass(self._log, fuse.compass_topic) if COMPASS in fuse.sensors else None,
        )

    def _wheels(self) -> Topic | None:
        """The topic of odometry: the one asked for, or the one of that type. A PoseStamped may be anything."""
        topic = self._odometry_topic()
        return topic if topic and (topic.type == ODOMETRY_TYPE or self._odom_topic) else None

    def _from_fusion(self, scans: ScanTimes) -> LaserPoses:
        """The laser's poses by odometry, GPS and compass together, smoothed."""
        sensed = read_sensors(self._log, *self._sensor_topics())
        if sensed.odometry is None and (sensed.gps is None or sensed.compass is None):
            raise LogReadError(
                self._log.path,
                f"fused poses need odometry, or a GPS and a compass: there is {sensed.topics or 'none of them'}",
                "give another --pose, or the topics by --odom-topic, --gps-topic and --compass-topic",
            )
        base = (sensed.odometry.base if sensed.odometry else "") or BASE_FRAME
        nodes = self._nodes(scans, base, sensed)
        fusion = Fusion(nodes, self._fuse.noise)
        estimate = fusion.smoothed()
        wanted = scans.wanted
        valid = (wanted >= nodes.stamps[0]) & (wanted <= nodes.stamps[-1])
        at = np.searchsorted(nodes.stamps, np.clip(wanted, nodes.stamps[0], nodes.stamps[-1]))
        mounts, upside_down, notes = self._mount(scans, base)
        if sensed.odometry:
            notes += _gap_note(sensed.odometry.topic, sensed.odometry.trajectory.stamps, scans.stamps)
        sensors = tuple(_sensors(sensed, estimate))
        return LaserPoses(
            FUSED,
            sensed.topics,
            compose(estimate.poses[at], mounts),
            valid,
            upside_down,
            notes + sensed.notes + _fusion_notes(sensors),
            covariances=carried(estimate.covariances[at], estimate.poses[at], mounts),
            frame_covariance=estimate.frame_covariance(scans.stamps),
            sensors=sensors,
            fusion=fusion,
            mounts=mounts,
        )

    def _nodes(self, scans: ScanTimes, base: str, sensed: Sensed) -> Nodes:
        """What is known of the base's motion, at the scans' stamps and at those of the readings."""
        gps, compass = sensed.gps, sensed.compass
        lever = self._fixed_mount(gps.frame_id, base)[1] if gps else np.zeros(3)
        turn = self._fixed_mount(compass.frame_id, base)[0] if compass else np.eye(3)
        try:
            return nodes_at(
                scans.wanted,
                sensed.odometry.trajectory if sensed.odometry else None,
                (gps.stamps, gps.values[:, :2]) if gps else None,
                (compass.stamps, headings(compass, turn)) if compass else None,
                (float(lever[0]), float(lever[1])),
            )
        except ValueError:
            what = f"no scan lies within the time of {sensed.topics}"
            raise LogReadError(self._log.path, what, "two clocks in one log? give another --pose") from None

    def _fixed_mount(self, frame: str, base: str) -> tuple[FloatArray, FloatArray]:
        """How a sensor's frame stands on the robot: rotation (3, 3), translation (3,); the base's own without one."""
        tree, chain = self._chain_to(base, frame)
        if len(chain) < 2:
            return np.eye(3), np.zeros(3)
        rotation, translation, _ = tree.lookup(chain, np.zeros(1, dtype=np.int64))
        return rotation[0], translation[0]

    def stand_still(self, scans: ScanTimes) -> LaserPoses:
        """A robot at the map's origin all the time, its laser where the offset or tf puts it."""
        mounts, upside_down, _ = self._mount(scans, BASE_FRAME)
        valid = np.ones(len(mounts), dtype=bool)
        return _with_ends(LaserPoses(STILL, "standing still", mounts, valid, upside_down), len(scans.stamps))

    def _mount(self, scans: ScanTimes, base: str) -> tuple[FloatArray, bool, tuple[str, ...]]:
        """Where the laser stands on the robot at every scan, whether upside down, and what had to be assumed."""
        frame = scans.frame_id.lstrip("/")
        tree, chain = self._chain_to(base, frame)
        rotation, translation, _ = tree.lookup(chain, scans.wanted)
        mounts, upside_down, notes = flatten(rotation, translation)
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
        rotation, translation, valid = self._tree.lookup(chain, scans.wanted)
        poses, upside_down, notes = flatten(rotation, translation)
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


def _with_ends(found: LaserPoses, scans: int) -> LaserPoses:
    """Poses found at first and last beams, told apart; where a last one's is not known it is the first one's."""
    if len(found.poses) == scans:
        return found
    valid, known = found.valid[:scans], found.valid[scans:, None]
    poses, ends = found.poses[:scans], found.poses[scans:]
    covariances = None if found.covariances is None else found.covariances[:scans]
    mounts = None if found.mounts is None else found.mounts[:scans]
    ends = np.where(known, ends, poses)
    return replace(found, poses=poses, valid=valid, ends=ends, covariances=covariances, mounts=mounts)


def compose(poses: FloatArray, mounts: FloatArray) -> FloatArray:
    """Poses (N, 3) of frames that are mounted at ``mounts`` (N, 3) on frames at ``poses`` (N, 3)."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cos * mounts[:, 0] - sin * mounts[:, 1]
    y = poses[:, 1] + sin * mounts[:, 0] + cos * mounts[:, 1]
    return np.column_stack((x, y, poses[:, 2] + mounts[:, 2]))


def carried(covariances: FloatArray, poses: FloatArray, mounts: FloatArray) -> FloatArray:
    """Covariances (N, 3, 3) of frames that are mounted at ``mounts`` (N, 3) on frames at ``poses`` (N, 3)."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.broadcast_to(np.eye(3), (len(poses), 3, 3)).copy()
    turn[:, 0, 2] = -(sin * mounts[:, 0] + cos * mounts[:, 1])
    turn[:, 1, 2] = cos * mounts[:, 0] - sin * mounts[:, 1]
    moved: FloatArray = turn @ covariances @ turn.transpose(0, 2, 1)
    return moved


def _sensors(sensed: Sensed, estimate: Estimate) -> Iterator[Sensor]:
    """The sensors that were fused, with the noise that was given or found; without it where it is neither."""
    noise = estimate.noise
    if sensed.odometry is not None:
        std = _known(m=noise.metres, rad=noise.radians)
        yield Sensor(ODOM, sensed.odometry.topic, len(sensed.odometry.trajectory), 0, std)
    if sensed.gps is not None:
        yield Sensor(GPS, sensed.gps.topic, *estimate.used(0), _known(m=noise.fixes))
    if sensed.compass is not None:
        std = _known(rad=noise.headings)
        yield Sensor(COMPASS, sensed.compass.topic, *estimate.used(1), std, noise.bias or 0.0)


def _known(**std: float | None) -> dict[str, float]:
    """The standard deviations that are known."""
    return {unit: value for unit, value in std.items() if value is not None}


def _fusion_notes(sensors: Sequence[Sensor]) -> tuple[str, ...]:
    """What a user should know of the sensors that were fused."""
    notes: tuple[str, ...] = ()
    if len(sensors) == 1:
        notes += (f"no GPS and no compass: fused poses are those of {sensors[0].topic}",)
    for sensor in sensors:
        if sensor.name != ODOM and not sensor.used:
            notes += (f"{sensor.topic}: no reading within the time of the poses was used",)
        elif sensor.rejected > MANY_REJECTED * (sensor.used + sensor.rejected):
            share = f"{sensor.rejected} of {sensor.used + sensor.rejected}"
            notes += (f"{sensor.topic}: {share} readings are too far off the other sensors' and were not used",)
        if sensor.bias:
            degrees = np.degrees(sensor.bias)
            notes += (f"{sensor.topic}: headings are off by {degrees:.1f} degrees all the time, which is taken out",)
    return notes
