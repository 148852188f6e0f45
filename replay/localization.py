"""Where the laser was: the poses of a log's scans by the options of a replay, and the scans with them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

from prim.errors import LogReadError
from prim.log.source import LogSource
from replay.options import ReplayOptions
from replay.posed_scans import PosedScanOptions, PosedScans, ScanLog
from replay.poses.fusion_options import FusionInputs, SensorNoise
from replay.poses.laser_poses import FUSED, LaserPoses
from replay.poses.pose_provider import PoseProvider
from replay.timing import StageTimer


class Localization(NamedTuple):
    """The poses of the laser at the scans of a log.

    Attributes:
        poses: The poses that the replay uses.
        true_poses: The true ones; None where the log has none, or none that can be used.
        notes: What a user should know of how they were chosen.
    """

    poses: LaserPoses
    true_poses: LaserPoses | None
    notes: tuple[str, ...]


def localize(log: LogSource, scans: ScanLog, options: ReplayOptions, timer: StageTimer) -> Localization:
    """Find the poses of the laser by the source that is asked for, matched where that is asked for.

    Args:
        log: The log.
        scans: The scans that are replayed.
        options: Options of the replay.
        timer: Counts the time of reading scans that are matched towards the stage «read».

    Returns:
        The poses, and the true ones where the log has them.

    Raises:
        LogReadError: The log has no such poses.
        UsageError: The options do not fit the log.
    """
    found = _look_up_poses(log, scans, options)
    if found.poses.mount_assumed:
        found = found._replace(poses=_with_suggested_mount(found.poses, scans, options, timer))
    if not options.match_scans:
        return found
    from replay.poses.scan_matching import match_scans  # when it is needed: a replay without it starts faster

    posed = partial(pose_scans, scans, options=options, timer=timer)
    poses = match_scans(
        found.poses, scans.stamps, posed, options.resolution, options.noise_std, options.fuse.noise, options.bounds
    )
    return found._replace(poses=poses)


def pose_scans(scans: ScanLog, poses: LaserPoses, options: ReplayOptions, timer: StageTimer) -> PosedScans:
    """Give scans their poses, and cut them where the laser moved by half a cell.

    Args:
        scans: The scans.
        poses: The laser's poses at these scans.
        options: Options of the replay.
        timer: Counts the time of reading towards the stage «read».

    Returns:
        The scans with their poses.
    """
    return PosedScans(scans, poses, PosedScanOptions(options.resolution / 2, options.max_range), timer)


def _with_suggested_mount(poses: LaserPoses, scans: ScanLog, options: ReplayOptions, timer: StageTimer) -> LaserPoses:
    """Add a note where the scans agree better with the laser elsewhere on the robot than at its origin."""
    from replay.poses.mount_estimation import estimate_mount  # when it is needed: a replay without it starts faster

    posed = partial(pose_scans, scans, options=options, timer=timer)
    estimate = estimate_mount(poses, scans.stamps, posed)
    if estimate is None or not estimate.is_significant():
        return poses
    return replace(poses, notes=(*poses.notes, estimate.note()))


def _look_up_poses(log: LogSource, scans: ScanLog, options: ReplayOptions) -> Localization:
    """Return the laser's poses by the source that is asked for, and the true ones where the log has them."""
    provider = PoseProvider(log, options.odom_topic, options.laser_offset, options.fuse)
    times = scans.times if options.deskew else replace(scans.times, sweep=0)
    if options.standing_still:
        return Localization(provider.stationary_poses(times), None, ())
    poses = provider.laser_poses(times, options.pose)
    fuse = replace(options.fuse, noise=SensorNoise()) if options.match_scans else options.fuse
    notes = []
    if fuse != FusionInputs() and poses.source != FUSED:
        notes.append(f"nothing is fused, since there are poses on {poses.origin}: give --pose fused")
    if poses.source == "truth":
        return Localization(poses, poses, tuple(notes))
    true_poses = None
    if provider.has_truth:
        try:
            true_poses = provider.laser_poses(times, "truth")
        except LogReadError as error:
            notes.append(f"the poses are not held against the truth: {error.what}")
    return Localization(poses, true_poses, tuple(notes))
