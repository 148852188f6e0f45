"""Where the laser was: the poses of a log's scans by the options of a replay, and the scans with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prim.arrays import Stamps
from prim.choices import PoseSourceName, SweepName
from prim.errors import LogReadError
from prim.scan import PosedScan
from prim.se2 import compose_poses, inverse_poses, path_length
from replay.options import ReplayOptions
from replay.poses.fusion_options import DEFAULTS as FUSION
from replay.poses.fusion_options import FusionInputs, SensorNoise
from replay.poses.laser_poses import (
    AT_ONCE,
    BEAM_TIMES,
    EXACT_SOURCES,
    FUSED,
    SCANS,
    BeamTimes,
    LaserPoses,
    ScanTimes,
    stated_beam_times,
)
from replay.poses.pose_provider import NoPosesError, PoseProvider
from replay.scans.posed_scans import PosedScanOptions, PosedScans
from replay.scans.scan_log import ScanLog
from replay.timing import StageTimer

_MEANINGS = {
    BEAM_TIMES[SweepName.START]: ("beams are measured from the stamp on", "--sweep start"),
    BEAM_TIMES[SweepName.END]: ("the stamp is the last beam's", "--sweep end"),
    BEAM_TIMES[SweepName.START_REVERSED]: ("the last beam is measured first, at the stamp", "--sweep start-reversed"),
    BEAM_TIMES[SweepName.END_REVERSED]: (
        "the last beam is measured first, and the stamp is the first beam's",
        "--sweep end-reversed",
    ),
    AT_ONCE: ("all beams of a scan are measured at its stamp", "--no-deskew"),
}
"""What times of beams mean, and the option that sets them."""


class Localization(NamedTuple):
    """The poses of the laser at the scans of a log.

    Attributes:
        scans: The scans, with the times at which their beams were measured.
        poses: The poses that the replay uses.
        true_poses: The true ones; None where the log has none, or none that can be used.
        notes: What a user should know of how they were chosen.
    """

    scans: ScanLog
    poses: LaserPoses
    true_poses: LaserPoses | None
    notes: tuple[str, ...]


def localize(scans: ScanLog, options: ReplayOptions, timer: StageTimer) -> Localization:
    """Find the poses of the laser by the source that is asked for, matched where that is asked for.

    Args:
        scans: The scans that are replayed.
        options: Options of the replay.
        timer: Counts the time of reading scans that are matched towards the stage «read».

    Returns:
        The poses, and the true ones where the log has them.

    Raises:
        LogReadError: The log has no such poses.
        UsageError: The options do not fit the log.
    """
    found = choose_poses(scans, options, timer)
    return _matched(found, options, timer) if found.poses.source == SCANS or options.match_scans else found


def choose_poses(scans: ScanLog, options: ReplayOptions, timer: StageTimer) -> Localization:
    """Choose the source of poses, without matching scans.

    Args:
        scans: The scans that are replayed.
        options: Options of the replay.
        timer: Counts the time of reading scans towards the stage «read».

    Returns:
        The poses; where the scans alone are to give them, those of a robot that stands still.

    Raises:
        LogReadError: The log has no such poses.
        UsageError: The options do not fit the log.
    """
    provider = PoseProvider(scans.log, options.odom_topic, options.laser_offset, options.fuse)
    found = _look_up_poses(provider, _retimed(scans, options), options)
    provider, found = _with_odometry_noise(provider, found, options, timer)
    found = _where_scans_fit(provider, found, options, timer)
    if found.poses.source == SCANS:
        return found
    if options.sweep == SweepName.AUTO:
        found = _with_beam_times_that_fit(provider, found, options, timer)
    elif not scans.sweep:
        note = f"--sweep {options.sweep} changes nothing: scans have no time_increment that is plausible"
        found = found._replace(notes=(*found.notes, note))
    if found.poses.mount_assumed and len(scans.scanners) == 1:
        found = found._replace(poses=_with_suggested_mount(found.poses, found.scans, options, timer))
    return found


def _matched(found: Localization, options: ReplayOptions, timer: StageTimer) -> Localization:
    """Match all scans: tracked by their points where cells are coarse and the noise is below them; else by a map.

    That is the forward map of all, which takes poses within its reach: those of odometry, else tracked ones.
    """
    from replay.mapping.bounds import bounds_of_bulk  # when they are needed: a replay without them starts faster
    from replay.poses.scan_matching import match_scans
    from replay.poses.tracking.laser_track import corrected_odometry, track_poses
    from replay.poses.tracking.options import DEFAULTS as TRACKING

    scans, poses = found.scans, found.poses
    posed = partial(pose_scans, scans, options=options, timer=timer)
    if poses.source == SCANS or _drift(poses, options.fuse.noise):
        settled_noise = options.resolution if options.resolution > TRACKING.coarse_cells else 0.0
        closed_noise = max(settled_noise, TRACKING.closed_noise) if poses.source == SCANS else settled_noise
        tracked, track = track_poses(poses, scans.times, posed, closed_noise)
        if track.noise_std < settled_noise:
            return found._replace(poses=replace(tracked, matched=True))
        if poses.source == SCANS or track.overrules:
            poses = tracked
        elif track.fits:
            poses = corrected_odometry(poses, scans.times, track.odometry_errors)
    bounds = options.bounds or bounds_of_bulk(posed(poses), options.resolution)
    poses = match_scans(poses, scans.stamps, posed, options.resolution, options.noise_std, options.fuse.noise, bounds)
    if poses.source == SCANS and not track.fits:
        note = (
            f"scans fit each other badly ({np.median(track.scores):.0%} of their points lie on the map of those "
            "before): poses by the scans alone may be far off, and how far is not known"
        )
        poses = replace(poses, covariances=None, frame_covariance=None, notes=(*poses.notes, note))
    return found._replace(poses=poses)


def _with_odometry_noise(
    provider: PoseProvider, found: Localization, options: ReplayOptions, timer: StageTimer
) -> tuple[PoseProvider, Localization]:
    """Fuse poses anew where scans show how noisy the odometry is, with the provider that does so."""
    fusion, noise = found.poses.fusion, options.fuse.noise
    is_given = noise.odometry_translation_std is not None and noise.odometry_rotation_std is not None
    if fusion is None or not fusion.nodes.has_odometry or is_given:
        return provider, found
    from replay.poses.tracking.odometry_noise import odometry_noise  # a replay by true poses starts faster

    odometry = _odometry(provider, found, options)
    std = odometry and odometry_noise(_windows(found.scans, odometry, options, timer)[0], FUSION)
    if not std:
        return provider, found
    provider = provider.with_odometry_noise(std)
    return provider, _look_up_poses(provider, found.scans, options)


def _windows(
    scans: ScanLog, poses: LaserPoses, options: ReplayOptions, timer: StageTimer
) -> list[list[list[PosedScan]]]:
    """Return windows of one laser's scans with their poses: of consecutive scans, and such that span all of them."""
    from replay.poses.tracking.scan_fit import fit_windows

    usable = np.flatnonzero(poses.valid & (scans.scanner == 0))
    usable = usable[np.argsort(scans.stamps[usable], kind="stable")]
    groups = [[usable[window] for window in windows] for windows in fit_windows(len(usable))]
    wanted = scans.only(np.unique(np.concatenate([window for group in groups for window in group])))
    posed = {one.position: one for one in pose_scans(wanted, poses, options, timer)}
    return [[[posed[number] for number in window if number in posed] for window in group] for group in groups]


def _where_scans_fit(
    provider: PoseProvider, found: Localization, options: ReplayOptions, timer: StageTimer
) -> Localization:
    """Hold poses against the scans: ``auto`` takes what these fit by, and what they do not fit by is noted."""
    poses, scans = found.poses, found.scans
    if poses.source in (*EXACT_SOURCES, SCANS):
        return found
    from replay.poses.tracking.scan_fit import ScanFit, scan_fit  # a replay by true poses starts faster

    def fits_by(by: LaserPoses) -> list[ScanFit]:
        return [scan_fit(windows) for windows in _windows(scans, by, options, timer)]

    is_auto = options.pose == PoseSourceName.AUTO and not options.odom_topic
    other = _odometry(provider, found, options) if is_auto and poses.source == FUSED else None
    if other is not None and poses.fusion is not None and poses.fusion.gain_over_odometry() < FUSION.least_gain:
        note = (
            f"{poses.origin} together show the robot's way no better than {other.origin} alone, which is used; "
            "to fuse give --pose fused"
        )
        found, poses, other = found._replace(poses=other, notes=(*found.notes, note)), other, None
    fits = fits_by(poses)
    if other is not None:
        others = fits_by(other)
        worse = [pair for pair in zip(fits, others, strict=True) if pair[0].is_worse_than(pair[1])]
        if worse and not any(b.is_worse_than(a) for a, b in zip(fits, others, strict=True)):
            fused, by_odometry = worse[0]
            note = (
                f"scans do not fit each other by fused poses: {fused.given:.0%} of their points lie on the map of "
                f"others, {by_odometry.given:.0%} by {other.origin}, which is used; to fuse give --pose fused"
            )
            found, poses, fits = found._replace(poses=other, notes=(*found.notes, note)), other, others
    bad = [fit for fit in fits if fit.is_bad()]
    if bad and is_auto and poses.source == PoseSourceName.ODOM and path_length(poses.poses[poses.valid]) == 0:
        times = scans.times if options.deskew else scans.times.at_once()
        note = f"{poses.origin} stands still where the scans do not: poses are found by the scans alone"
        return _at_rest(provider, scans, times, (*found.notes, note))
    if bad and not options.match_scans:
        note = (
            f"scans do not fit each other by these poses: {bad[0].given:.0%} of their points lie on the map of "
            f"others, {bad[0].matched:.0%} once they are matched: try --match-scans"
        )
        found = found._replace(notes=(*found.notes, note))
    return found


def _odometry(provider: PoseProvider, found: Localization, options: ReplayOptions) -> LaserPoses | None:
    """Return poses by odometry alone; None where there is none."""
    try:
        return provider.laser_poses(
            found.scans.times if options.deskew else found.scans.times.at_once(), PoseSourceName.ODOM
        )
    except LogReadError:
        return None


def _drift(poses: LaserPoses, noise: SensorNoise) -> bool:
    """Tell whether poses are those of an odometry, which no sensor holds."""
    is_known = noise.position_std is not None and noise.heading_std is not None
    return poses.fusion is None and not is_known and poses.source not in EXACT_SOURCES


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


def _retimed(scans: ScanLog, options: ReplayOptions) -> ScanLog:
    """Return scans whose beams were measured when the options say so."""
    return scans if options.sweep == SweepName.AUTO else scans.retimed(BEAM_TIMES[options.sweep])


def _with_suggested_mount(poses: LaserPoses, scans: ScanLog, options: ReplayOptions, timer: StageTimer) -> LaserPoses:
    """Add a note where the scans agree better with the laser elsewhere on the robot than at its origin."""
    from replay.poses.mount_estimation import estimate_mount  # when it is needed: a replay without it starts faster

    posed = partial(pose_scans, scans, options=options, timer=timer)
    estimate = estimate_mount(poses, scans.stamps, posed)
    if estimate is None or not estimate.is_significant():
        return poses
    return replace(poses, notes=(*poses.notes, estimate.note()))


def _look_up_poses(provider: PoseProvider, scans: ScanLog, options: ReplayOptions) -> Localization:
    """Return the laser's poses by the source that is asked for, and the true ones where the log has them."""
    times = scans.times if options.deskew else scans.times.at_once()
    if options.standing_still:
        return Localization(scans, provider.stationary_poses(times), None, ())
    try:
        if options.pose == SCANS:
            return _at_rest(provider, scans, times, ())
        poses = provider.laser_poses(times, options.pose)
    except NoPosesError as error:
        if options.pose != PoseSourceName.AUTO:
            raise
        return _at_rest(provider, scans, times, (f"{error.what}: they are found by the scans alone",))
    fuse = replace(options.fuse, noise=SensorNoise()) if options.match_scans else options.fuse
    notes = []
    if fuse != FusionInputs() and poses.source != FUSED:
        notes.append(f"nothing is fused, since there are poses on {poses.origin}: give --pose fused")
    if poses.source == "truth":
        return Localization(scans, poses, poses, tuple(notes))
    true_poses = None
    if provider.has_truth:
        try:
            true_poses = provider.laser_poses(times, "truth")
        except LogReadError as error:
            notes.append(f"the poses are not held against the truth: {error.what}")
    return Localization(scans, poses, true_poses, tuple(notes))


def _at_rest(provider: PoseProvider, scans: ScanLog, times: ScanTimes, notes: tuple[str, ...]) -> Localization:
    """Return the poses that tracking by the scans alone begins with: at the first true one, else at the origin."""
    poses = replace(provider.stationary_poses(times), source=SCANS, origin=scans.names)
    if not provider.has_truth:
        return Localization(scans, poses, None, notes)
    try:
        true_poses = provider.laser_poses(times, "truth")
    except LogReadError as error:
        return Localization(scans, poses, None, (*notes, f"the poses are not held against the truth: {error.what}"))
    first = np.flatnonzero(true_poses.valid)[:1]
    robot = compose_poses(true_poses.poses[first], inverse_poses(poses.poses[first]))
    begun = compose_poses(np.repeat(robot, len(poses.poses), axis=0), poses.poses)
    return Localization(scans, replace(poses, poses=begun, mounts=poses.poses), true_poses, notes)


def _with_beam_times_that_fit(
    provider: PoseProvider, found: Localization, options: ReplayOptions, timer: StageTimer
) -> Localization:
    """Return the poses at other times of the beams, where scans clearly fit each other better by these."""
    scans, poses = found.scans, found.poses
    if not scans.sweep or poses.end_poses is None or options.standing_still or len(scans.scanners) > 1:
        return found
    from replay.poses.sweep import find_beam_times  # when it is needed: a replay without it starts faster

    def read(positions: NDArray[np.intp]) -> Iterable[PosedScan]:
        return pose_scans(scans.only(positions), poses, options, timer)

    def poses_at(stamps: Stamps) -> LaserPoses:
        return provider.laser_poses(ScanTimes(stamps, (scans.first.frame_id,)), poses.source)

    measured = scans.first.ranges[scans.first.measured]
    reach = float(np.median(measured)) if len(measured) else 0.0
    finding = find_beam_times(scans.times, poses, reach, options.resolution / 2, read, poses_at)
    if finding is None:
        return found
    at_once = finding.times == AT_ONCE
    retimed = scans if at_once else scans.retimed(finding.times)
    other = _look_up_poses(provider, retimed, replace(options, deskew=not at_once))
    note = _finding_note(finding.times, stated_beam_times(scans.sweep), finding.gain, finding.deviations)
    return other._replace(notes=(*other.notes, note))


def _finding_note(times: BeamTimes, stated: BeamTimes, gain: float, deviations: float) -> str:
    """Describe times of beams that were found, and which options set them and those that the log says."""
    meaning, option = _MEANINGS[times]
    return (
        f"scans fit each other best where {meaning}: a beam's log-likelihood is {gain:.2g} nats above that by the "
        f"log's times ({deviations:.0f} standard errors); {option} sets this, {_MEANINGS[stated][1]} the log's times"
    )
