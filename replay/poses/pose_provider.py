"""The laser's pose at every scan: from the ground truth, the tf tree, odometry, or a fusion of sensors."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from prim.arrays import FloatArray, Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import Content
from prim.log.messages import BASE_FRAME, MAP_FRAME, TRUE_POSE_TOPIC
from prim.log.source import LogSource, Topic
from prim.se2 import Pose2D, compose_covariances, compose_poses
from prim.text import listed
from replay.poses.fusion import Fusion, PoseEstimate
from replay.poses.fusion_nodes import FusionNodes, TimedValues
from replay.poses.fusion_options import (
    COMPASS,
    GPS,
    IMU,
    ODOM,
    SENSORS,
    FusionInputs,
    FusionOptions,
    SensorNoise,
)
from replay.poses.laser_poses import FUSED, STILL, FusedSensor, LaserPoses, ScanTimes
from replay.poses.mount import SensorMounts, assumed_note
from replay.poses.odometry_errors import OdometryErrors
from replay.poses.sensors import (
    SCANS_HINT,
    SensorLogs,
    SensorTopics,
    compass_headings,
    find_compass,
    find_gps,
    find_imu,
    find_odometry,
    find_pose_topic,
    imu_headings,
    read_odometry,
    read_sensors,
)
from replay.poses.transforms import project_to_plane

OTHER_POSES = "take what poses there are: --pose auto"
"""What helps where a source of poses is not there."""


@dataclass(frozen=True)
class PoseProviderOptions:
    """The numbers of :class:`PoseProvider`; set by hand."""

    max_gap: float = 1.0
    """Poses further apart (s) are interpolated over a gap, which is reported."""

    max_rejected_share: float = 0.02
    """Where a larger share of a sensor's readings is rejected, it is reported."""

    min_upright: float = 0.97
    """A laser whose axis has a smaller cosine to the vertical is reported as tilted: by 14 degrees."""

    fusion: FusionOptions = field(default_factory=FusionOptions)


DEFAULTS = PoseProviderOptions()


class NoPosesError(LogReadError):
    """A log without poses, of any source."""


class _TfLink(NamedTuple):
    """How a laser is found in tf.

    Attributes:
        chain: Frames, each followed by its parent, up to a fixed one.
        offset: The laser's pose (1, 3) on the first of them; None: that is the laser's frame, or taken to be.
        notes: What was assumed.
        assumed: Whether the laser is only taken to be at the robot's origin.
    """

    chain: list[str]
    offset: FloatArray | None
    notes: tuple[str, ...] = ()
    assumed: bool = False


class PoseProvider:
    """Provides the laser's pose at every scan, from what a log holds: true poses, tf, odometry, or several sensors.

    Scans are not matched here; see :func:`replay.poses.scan_matching.match_scans`, and, for poses from scans alone,
    :func:`replay.poses.tracking.laser_track.track_poses`.

    Args:
        log: The log.
        odom_topic: The topic of the robot's poses, or of the odometry to be fused; None: found by type. Where one is
            given, the source ``auto`` means ``odom``.
        laser_offset: The laser's pose on the robot, in place of tf.
        inputs: What poses are fused from.
        options: Gaps, tilts, and the numbers of the fusion.
    """

    def __init__(
        self,
        log: LogSource,
        odom_topic: str | None = None,
        laser_offset: Pose2D | None = None,
        inputs: FusionInputs | None = None,
        options: PoseProviderOptions = DEFAULTS,
    ) -> None:
        self._log = log
        self._odom_topic = odom_topic
        self._inputs = inputs or FusionInputs()
        self._options = options
        self._mounts = SensorMounts(log, laser_offset, options.min_upright)

    def laser_poses(self, scans: ScanTimes, source: str = "auto") -> LaserPoses:
        """Find the laser's pose at every scan.

        Args:
            scans: When the scans were taken.
            source: One of PoseSourceName but ``scans``. ``auto`` means ``odom`` where an ``odom_topic`` was given;
                else it takes the ground truth, else a tf chain to ``map``, else what can be fused with a GPS or a
                compass, else any tf chain, else odometry.

        Returns:
            The poses; those of scans outside the time of the source are marked as invalid.

        Raises:
            NoPosesError: There are no poses at all.
            LogReadError: The source is not there or cannot be used, or no scan lies within its time.
        """
        poses = _split_end_poses(self._poses_from(source, scans), len(scans.stamps))
        if not poses.valid.any():
            first, last = scans.stamps.min() / 1e9, scans.stamps.max() / 1e9
            raise LogReadError(
                self._log.path,
                f"no scan (stamps {first:.3f} to {last:.3f} s) lies within the time of the poses on {poses.origin}",
                "two clocks in one log? by when messages were logged: --clock log",
            )
        return poses

    def with_odometry_noise(self, std: tuple[float, float]) -> PoseProvider:
        """Return a provider that fuses with another expectation of the odometry's noise.

        Args:
            std: Standard deviations (m, rad) after one metre.

        Returns:
            The provider.
        """
        other = copy(self)
        other._options = replace(self._options, fusion=replace(self._options.fusion, default_odometry_std=std))
        return other

    def stationary_poses(self, scans: ScanTimes) -> LaserPoses:
        """Return the poses of a robot that stands at the map's origin at all times.

        Args:
            scans: When the scans were taken.

        Returns:
            The laser's poses, all valid, where the offset or tf puts it.
        """
        mounts, upside_down, *_ = self._mounts.laser_mounts(scans, BASE_FRAME)
        valid = np.ones(len(mounts), dtype=bool)
        poses = LaserPoses(STILL, "standing still", mounts, valid, upside_down)
        return _split_end_poses(poses, len(scans.stamps))

    @property
    def has_truth(self) -> bool:
        """Whether the log has true poses."""
        topic = self._log.topics.get(TRUE_POSE_TOPIC)
        return topic is not None and topic.messages > 0 and topic.content is Content.POSE

    def _poses_from(self, source: str, scans: ScanTimes) -> LaserPoses:
        """Return the poses at all query stamps, by the source that is asked for or that ``auto`` chooses."""
        if source == "auto" and self._odom_topic is not None:
            source = "odom"
        if source == "truth" or (source == "auto" and self.has_truth):
            return self._from_truth(scans)
        if source == "odom":
            return self._from_odometry(scans, source)
        if source == FUSED:
            return self._from_fusion(scans)
        chains = self._tf_chains(scans)
        reason: tuple[str, ...] = ()
        if source == "auto" and not all(chain[-1] == MAP_FRAME for chain in chains):
            try:
                if self._can_fuse():
                    return self._from_fusion(scans)
            except LogReadError as error:
                if replace(self._inputs, noise=SensorNoise()) != FusionInputs():
                    raise
                reason = (f"nothing is fused: {error.what}",)
        use_tf = source == "tf" or all(len(chain) > 1 for chain in chains) or self._needs_robot_in_tf(scans)
        poses = self._from_tf(scans, chains) if use_tf else self._from_odometry(scans, source)
        return replace(poses, notes=poses.notes + reason)

    def _tf_chains(self, scans: ScanTimes) -> list[list[str]]:
        """Return the chain of frames from each laser up to a fixed frame; without one, its frame alone."""
        return [self._mounts.fixed_chain(self._mounts.scanner_frame(frame)[0]) for frame in scans.frame_ids]

    def _needs_robot_in_tf(self, scans: ScanTimes) -> bool:
        """Return whether tf has the robot, if not the laser, where no topic has its poses."""
        if self._mounts.robot_frame(scans.frame_ids[0]) is None:
            return False
        try:
            return find_pose_topic(self._log, self._odom_topic) is None
        except LogReadError:
            return True

    def _from_truth(self, scans: ScanTimes) -> LaserPoses:
        if not self.has_truth:
            raise LogReadError(self._log.path, f"no ground truth: there is no {TRUE_POSE_TOPIC}", OTHER_POSES)
        return self._from_topic(scans, self._log.topics[TRUE_POSE_TOPIC], "truth")

    def _from_odometry(self, scans: ScanTimes, source: str) -> LaserPoses:
        topic = find_pose_topic(self._log, self._odom_topic)
        if topic is None:
            everything = "no ground truth, no tf chain, " if source == "auto" else ""
            raise NoPosesError(
                self._log.path,
                f"no poses for frame {scans.frame_ids[0]!r}: {everything}no Odometry or PoseStamped",
                "; ".join(
                    [
                        *self._mounts.tree_notes,
                        *self._log.lost,
                        SCANS_HINT,
                    ]
                ),
            )
        return self._from_topic(scans, topic, "odom")

    def _from_topic(self, scans: ScanTimes, topic: Topic, source: str) -> LaserPoses:
        """Return the robot's poses on a topic, composed with the laser's mount."""
        odometry = read_odometry(self._log, topic)
        robot, valid = odometry.trajectory.at(scans.query_stamps)
        mounts, upside_down, notes, assumed = self._mounts.laser_mounts(scans, odometry.base_frame)
        notes += self._gap_note(topic.name, odometry.trajectory.stamps, scans.stamps) + odometry.notes
        poses = compose_poses(robot, mounts)
        several = mounts if len(scans.frame_ids) > 1 else None
        return LaserPoses(source, topic.name, poses, valid, upside_down, notes, mounts=several, mount_assumed=assumed)

    def _from_tf(self, scans: ScanTimes, chains: Sequence[list[str]]) -> LaserPoses:
        """Return the lasers' poses in the fixed frame of tf: by their chains, else at the robot's frame."""
        tree, robot = self._mounts.tree, self._mounts.robot_frame(scans.frame_ids[0])
        if self._mounts.tree_notes and not tree.edges:
            raise LogReadError(self._log.path, *self._mounts.tree_notes)
        self._mounts.check_offset(scans)
        stamps = scans.query_stamps
        poses, valid = np.zeros((len(stamps), 3)), np.zeros(len(stamps), dtype=bool)
        upside_down = np.zeros(len(stamps), dtype=bool)
        notes: tuple[str, ...] = ()
        origins, assumed = [], False
        for k, frame in enumerate(scans.frame_ids):
            rows = scans.query_rows(k)
            link = self._tf_link(frame, chains[k], robot)
            rotation, translation, valid[rows] = tree.lookup(link.chain, stamps[rows])
            planar = project_to_plane(rotation, translation, self._options.min_upright)
            poses[rows] = compose_poses(planar[0], link.offset) if link.offset is not None else planar[0]
            upside_down[rows] = planar[1]
            notes += planar[2] + link.notes + self._tf_notes(link.chain, scans.stamps)
            origins.append(" > ".join(reversed(link.chain)))
            assumed |= link.assumed
        roots = sorted({origin.split(" > ")[0] for origin in origins})
        if len(roots) > 1:
            what = f"tf has the scanners in different fixed frames ({', '.join(roots)})"
            raise LogReadError(
                self._log.path, what, f"choose one scanner with --scan-topic {shlex.quote(scans.topics[0])}"
            )
        notes += tuple(f"{frame} has several parents in tf: {parent} is used" for frame, parent in tree.conflicts)
        unique = tuple(dict.fromkeys(notes))
        origin = ", ".join(origins)
        mounts = self._mounts.laser_mounts(scans, robot or roots[0]).poses if len(scans.frame_ids) > 1 else None
        return LaserPoses("tf", origin, poses, valid, upside_down, unique, mounts=mounts, mount_assumed=assumed)

    def _tf_link(self, name: str, chain: list[str], robot: str | None) -> _TfLink:
        """Return how a laser is found in tf: by its own chain, else by the robot's. Raises LogReadError."""
        offset = self._mounts.offset
        if len(chain) > 1:
            notes = self._mounts.scanner_frame(name)[1]
            return _TfLink(
                chain, None, notes + ("--laser-offset is not used: tf says where the laser is",) * bool(offset)
            )
        if robot is None:
            tree = self._mounts.tree
            frames = listed(sorted({*tree.edges, *tree.parents}))
            what = f"tf has no chain from {name!r} to a fixed frame (its frames: {frames or 'none'})"
            raise LogReadError(self._log.path, what, OTHER_POSES)
        robot_chain = self._mounts.fixed_chain(robot)
        if offset is not None:
            return _TfLink(robot_chain, np.array([[offset.x, offset.y, offset.theta]]))
        return _TfLink(robot_chain, None, (assumed_note(robot, name.lstrip("/")),), assumed=True)

    def _tf_notes(self, chain: Sequence[str], stamps: Stamps) -> tuple[str, ...]:
        """Return what a user should know of the transforms in a chain: gaps, and contradictions."""
        tree = self._mounts.tree
        notes: tuple[str, ...] = ()
        for frame in chain[:-1]:
            parent, series = tree.edges[frame]
            if not series.static:
                notes += self._gap_note(f"tf from {parent} to {frame}", series.stamps, stamps)
        return notes + tree.contradictions(chain)

    def _can_fuse(self) -> bool:
        """Return whether the log has a GPS or compass to fuse with, as far as ``auto`` is concerned."""
        try:
            topics = self._sensor_topics()
        except LogReadError:
            return False
        return bool((topics.odometry and (topics.gps or topics.compass)) or (topics.gps and topics.compass))

    def _sensor_topics(self) -> SensorTopics:
        """Return the topics of the sensors that are there and asked for: headings are a compass's, else an IMU's."""
        inputs, log = self._inputs, self._log
        has_compass = COMPASS in inputs.sensors and inputs.imu_topic is None
        compass = find_compass(log, inputs.compass_topic) if has_compass else None
        return SensorTopics(
            find_odometry(log, self._odom_topic) if ODOM in inputs.sensors else None,
            find_gps(log, inputs.gps_topic) if GPS in inputs.sensors else None,
            compass,
            self._imu_topic() if IMU in inputs.sensors and compass is None else None,
        )

    def _imu_topic(self) -> Topic | None:
        """Return the topic of an IMU; None where there are several, and none was asked for."""
        try:
            return find_imu(self._log, self._inputs.imu_topic)
        except LogReadError:
            if self._inputs.imu_topic is not None or self._inputs.sensors != SENSORS:
                raise
            return None

    def _from_fusion(self, scans: ScanTimes) -> LaserPoses:
        """Return the robot's poses by all sensors, smoothed and composed with the laser's mount."""
        sensors = read_sensors(self._log, self._sensor_topics())
        if sensors.odometry is None and (sensors.gps is None or sensors.compass is None):
            raise LogReadError(
                self._log.path,
                f"fused poses need odometry, or a GPS and a compass: there is {sensors.topics or 'none of them'}",
                OTHER_POSES,
            )
        base = (sensors.odometry.base_frame if sensors.odometry else "") or BASE_FRAME
        nodes = self._nodes(scans, base, sensors)
        fusion = Fusion(nodes, self._inputs.noise, self._options.fusion)
        estimate = fusion.smoothed()
        stamps, first, last = scans.query_stamps, nodes.stamps[0], nodes.stamps[-1]
        at = np.searchsorted(nodes.stamps, np.clip(stamps, first, last))
        robot = estimate.poses[at]
        mounts, upside_down, notes, assumed = self._mounts.laser_mounts(scans, base)
        if sensors.odometry:
            notes += self._gap_note(sensors.odometry.topic, sensors.odometry.trajectory.stamps, scans.stamps)
        fused_sensors = tuple(_fused_sensors(sensors, estimate))
        return LaserPoses(
            FUSED,
            sensors.topics,
            compose_poses(robot, mounts),
            (stamps >= first) & (stamps <= last),
            upside_down,
            notes + sensors.notes + self._fusion_notes(fused_sensors),
            covariances=compose_covariances(estimate.covariances[at], robot, mounts),
            frame_covariance=estimate.frame_covariance(scans.stamps),
            sensors=fused_sensors,
            fusion=fusion,
            mounts=mounts,
            mount_assumed=assumed,
        )

    def _nodes(self, scans: ScanTimes, base: str, sensors: SensorLogs) -> FusionNodes:
        """Return the measurements of the base's motion, at the query stamps and at those of the readings."""
        gps = sensors.gps
        lever_arm = self._mounts.sensor_mount(gps.frame_id, base)[1] if gps else np.zeros(3)
        try:
            return FusionNodes.from_readings(
                scans.query_stamps,
                sensors.odometry.trajectory if sensors.odometry else None,
                (gps.stamps, gps.values[:, :2]) if gps else None,
                self._headings(scans, base, sensors),
                (float(lever_arm[0]), float(lever_arm[1])),
                self._options.fusion,
                gps.stds if gps else None,
                sensors.imu is None,
            )
        except ValueError:
            what = f"no scan lies within the time of {sensors.topics}"
            raise LogReadError(
                self._log.path, what, "two clocks in one log? by when messages were logged: --clock log"
            ) from None

    def _headings(self, scans: ScanTimes, base: str, sensors: SensorLogs) -> TimedValues | None:
        """Return the base's headings by the compass, or by the IMU: at the scans, which are fewer."""
        compass, imu = sensors.compass, sensors.imu
        if compass:
            rotation = self._mounts.sensor_mount(compass.frame_id, base)[0]
            return compass.stamps, compass_headings(compass, rotation)
        if imu is None:
            return None
        stamps = np.unique(scans.stamps)
        stamps = stamps[(stamps >= imu.stamps[0]) & (stamps <= imu.stamps[-1])]
        headings = imu_headings(imu, self._mounts.sensor_mount(imu.frame_id, base)[0])
        return (stamps, np.interp(stamps, imu.stamps, headings)) if len(stamps) else None

    def _gap_note(self, what: str, poses: Stamps, scans: Stamps) -> tuple[str, ...]:
        """Return a note where scans (stamps in ns) lie between poses that are far apart in time."""
        after = np.clip(np.searchsorted(poses, scans), 1, max(len(poses) - 1, 1))
        if len(poses) < 2:
            return ()
        inside = (scans > poses[after - 1]) & (scans < poses[after])
        gaps = np.where(inside, poses[after] - poses[after - 1], 0) / 1e9
        wide = int(np.count_nonzero(gaps > self._options.max_gap))
        if not wide:
            return ()
        scans_lie = "1 scan lies" if wide == 1 else f"{wide} scans lie"
        return (f"{what}: {scans_lie} in a gap of up to {gaps.max():.1f} s between poses, and are placed in between",)

    def _fusion_notes(self, sensors: Sequence[FusedSensor]) -> tuple[str, ...]:
        """Return what a user should know of the sensors that were fused."""
        notes: tuple[str, ...] = ()
        if len(sensors) == 1:
            notes += (f"no GPS, no compass and no IMU: fused poses are those of {sensors[0].topic}",)
        for sensor in sensors:
            total = sensor.used + sensor.rejected
            if sensor.name != ODOM and not sensor.used:
                notes += (f"{sensor.topic}: no reading within the time of the poses was used",)
            elif sensor.rejected > self._options.max_rejected_share * total:
                share = f"{sensor.rejected} of {total}"
                notes += (f"{sensor.topic}: {share} readings are too far off the other sensors' and were not used",)
            if sensor.bias and sensor.name == COMPASS:
                degrees = np.degrees(sensor.bias)
                notes += (
                    f"{sensor.topic}: headings are off by {degrees:.1f} degrees all the time, which is taken out",
                )
            if sensor.wander:
                size = f"{sensor.wander.std:.2f} m" if sensor.name == GPS else f"{np.degrees(sensor.wander.std):.1f}°"
                slow = f"errors wander by {size} over {sensor.wander.time:.0f} s"
                notes += (f"{sensor.topic}: {slow}, beside those that change from reading to reading: both count",)
            notes += OdometryErrors(*sensor.scales).notes(sensor.topic)
        return notes


def _split_end_poses(queried: LaserPoses, scans: int) -> LaserPoses:
    """Separate the poses at the last beams from those at the first, which stand in where a last one is not known."""
    if len(queried.poses) == scans:
        return queried

    def first(rows: FloatArray | None) -> FloatArray | None:
        return None if rows is None else rows[:scans]

    poses, known = queried.poses[:scans], queried.valid[scans:, None]
    return replace(
        queried,
        poses=poses,
        valid=queried.valid[:scans],
        end_poses=np.where(known, queried.poses[scans:], poses),
        covariances=first(queried.covariances),
        mounts=first(queried.mounts),
        upside_down=None if queried.upside_down is None else queried.upside_down[:scans],
    )


def _fused_sensors(sensors: SensorLogs, estimate: PoseEstimate) -> Iterator[FusedSensor]:
    """Yield the sensors that were fused, with the noise that was given or estimated."""
    noise = estimate.noise
    if sensors.odometry is not None:
        std = _known(m=noise.odometry_translation_std, rad=noise.odometry_rotation_std)
        count, scales = len(sensors.odometry.trajectory), (noise.distance_scale or 1.0, noise.turn_scale or 1.0)
        yield FusedSensor(ODOM, sensors.odometry.topic, count, 0, std, scales=scales)
    if sensors.gps is not None:
        counts, std = estimate.reading_counts(0), _known(m=noise.position_std)
        yield FusedSensor(GPS, sensors.gps.topic, *counts, std, wander=noise.position_wander)
    north = sensors.compass or sensors.imu
    if north is not None:
        counts, std, name = (
            estimate.reading_counts(1),
            _known(rad=noise.heading_std),
            COMPASS if sensors.compass else IMU,
        )
        bias = noise.heading_bias or 0.0
        yield FusedSensor(name, north.topic, *counts, std, bias, noise.heading_wander)


def _known(**std: float | None) -> dict[str, float]:
    """Return the standard deviations that are known."""
    return {unit: value for unit, value in std.items() if value is not None}
