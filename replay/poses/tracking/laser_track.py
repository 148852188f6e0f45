"""A log's poses by tracking its scans, and what a user should know of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from prim.arrays import FloatArray
from prim.se2 import Trajectory, compose_poses, inverse_poses, path_length, relative_poses, wrap_angles
from replay.poses.laser_poses import SCANS, LaserPoses, PosedScanSource, PoseLoops, ScanTimes
from replay.poses.loops.loop_closing import ClosedLoops
from replay.poses.odometry_errors import OdometryErrors, find_odometry_errors
from replay.poses.tracking.options import DEFAULTS, TrackingOptions
from replay.poses.tracking.scan_tracker import ScanTrack, track


def track_poses(
    poses: LaserPoses,
    times: ScanTimes,
    source: PosedScanSource,
    settled_noise: float = math.inf,
    options: TrackingOptions = DEFAULTS,
) -> tuple[LaserPoses, ScanTrack]:
    """Find a log's poses by its scans, with its odometry or without.

    The scans of the first laser are tracked; others follow by their places on the robot.

    Args:
        poses: The laser's poses at N scans by odometry; or, of the source ``scans``, those of a robot that stands
            still, from which they are found.
        times: When the scans were taken, and by which laser.
        source: Yields the scans with the poses that it is given.
        settled_noise: As :func:`replay.poses.tracking.scan_tracker.track` has it.
        options: Windows, maps, limits.

    Returns:
        The poses, the first one as it was, with notes; and the track.
    """
    alone = poses.source == SCANS
    mounts = poses.poses if alone and poses.mounts is None else _mounts_of(poses)
    placed, found = _tracked(poses, mounts, times, source, not alone, settled_noise, options)
    if alone and placed.end_poses is not None:  # how the laser moves during a sweep is known now
        placed, found = _tracked(placed, mounts, times, source, True, settled_noise, options)
    if not alone:
        found = replace(found, odometry_errors=_odometry_errors(poses, placed, mounts, times))
    notes = track_notes(found, None if alone else poses, times)
    return replace(placed, notes=(*poses.notes, *notes)), found


def corrected_odometry(poses: LaserPoses, times: ScanTimes, errors: OdometryErrors) -> LaserPoses:
    """Take the scales that were found out of poses by odometry.

    Args:
        poses: The laser's poses at N scans by odometry.
        times: When the scans were taken.
        errors: What is wrong with the odometry.

    Returns:
        The poses, from the same first one on, with notes.
    """
    if not errors.has_scales:
        return replace(poses, notes=(*poses.notes, *errors.notes(poses.origin)))
    mounts, order = _mounts_of(poses), np.flatnonzero(poses.valid)
    order = order[np.argsort(times.stamps[order], kind="stable")]
    corrected = poses.poses.copy()
    robot = errors.corrected(compose_poses(poses.poses, inverse_poses(mounts))[order])
    corrected[order] = compose_poses(robot, mounts[order])
    corrected[:, 2] = wrap_angles(corrected[:, 2])
    ends = poses.end_poses
    if ends is not None:
        ends = compose_poses(corrected, relative_poses(poses.poses, ends))
    return replace(poses, poses=corrected, end_poses=ends, notes=(*poses.notes, *errors.notes(poses.origin)))


def _odometry_errors(
    odometry: LaserPoses, placed: LaserPoses, mounts: FloatArray, times: ScanTimes
) -> OdometryErrors:
    """Find what is wrong with an odometry all the time, by poses that were tracked."""
    first = True if times.scanner is None else times.scanner == 0
    at = np.flatnonzero(odometry.valid & placed.valid & first)
    at = at[np.argsort(times.stamps[at], kind="stable")]
    at = at[np.diff(times.stamps[at], prepend=times.stamps[at[:1]] - 1) > 0]
    backs = inverse_poses(mounts[at])
    by_odometry, tracked = (compose_poses(poses.poses[at], backs) for poses in (odometry, placed))
    return find_odometry_errors(times.stamps[at], by_odometry, tracked)


def _tracked(
    poses: LaserPoses,
    mounts: FloatArray,
    times: ScanTimes,
    source: PosedScanSource,
    predicts: bool,
    settled_noise: float,
    options: TrackingOptions,
) -> tuple[LaserPoses, ScanTrack]:
    """ScanTrack the first laser's scans, predicted by the poses or not, and place all lasers' by these."""
    scans = sorted((posed for posed in source(poses) if not posed.scanner), key=lambda posed: posed.scan.stamp)
    at = np.array([posed.position for posed in scans])
    found = track(scans, poses.poses[at] if predicts else None, settled_noise, options)
    lasers = compose_poses(np.repeat(poses.poses[at[:1]], len(at), axis=0), found.poses)
    robot = Trajectory.from_unsorted(times.stamps[at], compose_poses(lasers, inverse_poses(mounts[at])))
    count = len(poses.poses)
    stamps = times.query_stamps
    places, within = robot.at(stamps)
    whole = compose_poses(places[:count], mounts)
    whole[:, 2] = wrap_angles(whole[:, 2])
    ends = compose_poses(places[count:], mounts) if poses.end_poses is not None else None
    several = mounts if len(times.frame_ids) > 1 else poses.mounts
    valid = poses.valid & within[:count]
    placed = replace(poses, poses=whole, end_poses=ends, valid=valid, mounts=several)
    if found.closed is not None:
        frames = at[list(found.keyframes)]
        recognised = [(frames[loop.first], frames[loop.last]) for loop in found.closed.loops]
        pairs = np.array(recognised, np.intp).reshape(-1, 2)
        placed = replace(placed, loops=PoseLoops(found.closed.closed, rejected_counts(found.closed), pairs))
    if found.errors is not None:
        turn = _turned_by(lasers[0, 2])
        nearest = np.clip(np.searchsorted(times.stamps[at], times.stamps), 0, len(at) - 1)
        placed = replace(placed, covariances=(turn @ found.errors.since_first() @ turn.T)[nearest])
    return placed, found


def _turned_by(angle: float) -> FloatArray:
    """Return the matrix (3, 3) that turns errors of poses (x, y, heading) by an angle (rad)."""
    turn = np.eye(3)
    turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return turn


def _mounts_of(poses: LaserPoses) -> FloatArray:
    """Return the lasers' poses (N, 3) on the robot; zeros where those of a single one are the robot's."""
    return np.zeros_like(poses.poses) if poses.mounts is None else poses.mounts


def track_notes(found: ScanTrack, odometry: LaserPoses | None, times: ScanTimes) -> tuple[str, ...]:
    """Return what a user should know of a track: where odometry was not followed, and where scans fit nowhere.

    Args:
        found: The track.
        odometry: The poses that it was predicted by; None for none.
        times: When the scans were taken.

    Returns:
        The notes.
    """
    notes: list[str] = []
    count, begin = len(found.poses), times.stamps.min()
    if odometry is not None:
        given, tracked = path_length(odometry.poses[odometry.valid]), path_length(found.poses)
        notes += found.odometry_errors.notes(odometry.origin)
        if found.stands_still:
            notes.append(
                f"{odometry.origin} moves by {given:.2f} m where the scans move by {tracked:.1f} m: they are followed"
            )
        elif found.overruled:
            stamps = np.sort(times.stamps[odometry.valid])[list(found.overruled)]
            seconds = (int(stamps[0]) - int(begin)) / 1e9
            what = "scan" if len(found.overruled) == 1 else "scans"
            notes.append(
                f"{odometry.origin} is off by more than is plausible at {len(found.overruled)} {what} of {count}, "
                f"first at {seconds:.1f} s: the scans are followed there"
            )
    if found.broken:
        what = "scan fits" if len(found.broken) == 1 else "scans fit"
        notes.append(
            f"{len(found.broken)} {what} nowhere near those before, the first one number {found.broken[0]}: "
            "what lies before and after may not belong together"
        )
    if found.closed is not None:
        notes += loop_notes(found.closed)
    return tuple(notes)


def loop_notes(closed: ClosedLoops) -> list[str]:
    """Return what a user should know of loops.

    Args:
        closed: Those that were closed, and how many recognised places were rejected.

    Returns:
        A note; none where nothing was recognised.
    """
    rejected = rejected_counts(closed)
    if not closed.closed and not rejected:
        return []
    what = {0: "no loop closed", 1: "1 loop closed"}.get(closed.closed, f"{closed.closed} loops closed")
    reasons = ", ".join(f"{count} rejected as {reason}" for reason, count in rejected.items())
    return [f"{what}, {reasons}" if reasons else what]


def rejected_counts(closed: ClosedLoops) -> dict[str, int]:
    """Return how many recognised keyframes were rejected, by the reason, in the order of the alphabet.

    Args:
        closed: The loops.

    Returns:
        The counts, none of them 0.
    """
    return dict(sorted((reason.value, count) for reason, count in closed.rejected.items()))
