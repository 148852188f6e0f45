"""How well held-out scans of a building fit the map of the others, by poses from odometry, scans, and corrected ones.

Two logs of one building: the raw one, and one with a third of its scans and with poses that others have corrected.
Of the scans that both have, every fifth is held out, and the map is made of the rest. Held-out scans take no part in
their poses: those of the raw log are found from all its other scans, by odometry or without. Each held-out scan is
then localised against the map alone: from where it lies between its neighbours in time, or, for the given poses, from
the given one, its likelihood is maximised. Compared are the log-likelihoods of its rays there.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.heldout import EVERY, Posed, fit_level, frame_of, rays_of, score
from mapping.forward.mapper import ForwardMapper
from mapping.forward.scan_likelihood import ScanLikelihood, ScanRays, maximize_pose
from prim.arrays import FloatArray
from prim.log import open_log
from prim.scan import Scan
from prim.se2 import Pose2D, compose_poses, inverse_poses
from replay.localization import localize
from replay.options import ReplayOptions
from replay.poses.fusion_options import SensorNoise
from replay.poses.pose_provider import PoseProvider
from replay.poses.scan_matching import DEFAULTS as MATCHING
from replay.poses.scan_matching import match_scans
from replay.scans.posed_scans import PosedScanOptions, PosedScans
from replay.scans.scan_log import ScanLog
from replay.scans.selection import Selection
from replay.timing import StageTimer

NORMAL_95 = 1.96
"""95 % of normal numbers lie within so many standard deviations."""

CSAIL_RESOLUTION = 0.05
CSAIL_NOISE = {"as given": (0.05, 0.5), "with 0.1 m and 2° of noise": (0.1, 2.0)}
"""The noise of poses that do not drift, as given to the matcher: m, degrees."""

RAW = {
    "raw, odometry": ReplayOptions(pose="odom", match_scans=True, resolution=CSAIL_RESOLUTION),
    "raw, scans alone": ReplayOptions(pose="scans", resolution=CSAIL_RESOLUTION),
}
"""How poses of the raw log are found."""

LOCALISATION_NOISE = (8.0, 4.0, 2.0, 1.0)
"""Localising a scan, from coarse to fine: the range noise times these."""

LOCALISATION_ROUNDS = 5
"""How often each of these steps is repeated: a single one may end before the maximum."""


def csail_table(path: Path) -> str:
    """Compare the log-likelihood of held-out scans of csail.mcap (nats per ray) before and after matching."""
    lines = ["| poses of csail.mcap | held-out, nats per ray | matched | time |", "|---|---:|---:|---:|"]
    with open_log(path) as log:
        scans = ScanLog(log, Selection())
        given = PoseProvider(log).laser_poses(scans.times)
        posed_scans = partial(PosedScans, scans, options=PosedScanOptions(CSAIL_RESOLUTION / 2))
        rng = np.random.default_rng(1)
        for name, (metres, degrees) in CSAIL_NOISE.items():
            noise = np.zeros_like(given.poses)
            if name != "as given":
                noise[:, :2] = rng.normal(0, metres, (len(noise), 2))
                noise[:, 2] = rng.normal(0, math.radians(degrees), len(noise))
            poses = replace(given, poses=given.poses + noise)
            start = time.perf_counter()
            given_noise = SensorNoise(metres, math.radians(degrees))
            matched = match_scans(poses, scans.stamps, posed_scans, CSAIL_RESOLUTION, None, given_noise)
            spent = time.perf_counter() - start
            before, after = (
                held_out([(posed.scan, posed.pose) for posed in posed_scans(of)]) for of in (poses, matched)
            )
            lines.append(f"| {name} | {before:.3f} | {after:.3f} | {spent:.0f} s |")
    return "\n".join(lines)


def held_out(scans: Posed) -> float:
    """Return the mean log-likelihood of a ray of every fifth scan under the map of the others (nats)."""
    frame = frame_of(scans, CSAIL_RESOLUTION)
    training = [item for number, item in enumerate(scans) if number % EVERY]
    mapper = ForwardMapper(CSAIL_RESOLUTION, frame.bounds)
    for scan, pose in training:
        mapper.accumulate(scan, pose)
    return score(mapper.fit().stopping, frame, rays_of(training), rays_of(scans[::EVERY]))[0]


def heldout_table(given_path: Path, raw_path: Path) -> str:
    """Compare poses of the raw log with the given ones by held-out scans that are localised against the map alone."""
    with open_log(given_path) as given_log, open_log(raw_path) as raw_log:
        given, raw = ScanLog(given_log, Selection()), ScanLog(raw_log, Selection())
        given_poses = PoseProvider(given_log).laser_poses(given.times).poses
        scans = [scan for _, scan in given]
        common = same_scans(scans, [scan for _, scan in raw], given.stamps, raw.stamps)
        found = {"given": (given_poses, 0.0)}
        kept = np.setdiff1d(np.arange(len(raw)), common[::EVERY])
        for name, options in RAW.items():
            start = time.process_time()
            poses = localize(raw.only(kept), options, StageTimer()).poses
            found[name] = aligned(poses.poses[common], given_poses), time.process_time() - start
    scores = {name: localised(scans, poses) for name, (poses, _) in found.items()}
    lines = [
        "| poses | nats per ray of held-out scans | above the given ones | moved by localising, mm | CPU |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, (nats, moved) in scores.items():
        gain = nats - scores["given"][0]
        error = NORMAL_95 * gain.std(ddof=1) / math.sqrt(len(gain))
        cells = "" if name == "given" else f"{gain.mean():+.3f} ± {error:.3f}"
        spent = "" if name == "given" else f"{found[name][1]:.0f} s"
        lines.append(f"| {name} | {nats.mean():.3f} | {cells} | {1000 * np.median(moved):.0f} | {spent} |")
    text = (
        f"{len(gain)} held-out scans of {len(scans)} that both logs have; ±: 95 % over these, paired; moved: median."
    )
    return "\n".join([*lines, "", text])


def same_scans(
    wanted: list[Scan], others: list[Scan], stamps: NDArray[np.int64], other_stamps: NDArray[np.int64]
) -> NDArray[np.intp]:
    """Return the positions, among ``others``, of the scans with the same ranges; of several the nearest in time."""
    places: dict[bytes, list[int]] = {}
    for number, scan in enumerate(others):
        places.setdefault(scan.ranges.tobytes(), []).append(number)
    nearest = [
        min(places[scan.ranges.tobytes()], key=lambda number: abs(int(other_stamps[number] - stamp)))
        for scan, stamp in zip(wanted, stamps, strict=True)
    ]
    return np.array(nearest, dtype=np.intp)


def aligned(poses: FloatArray, reference: FloatArray) -> FloatArray:
    """Move poses (N, 3) together so that they lie nearest to the reference's places (N, 3): maps share a frame."""
    centre, to = poses[:, :2].mean(axis=0), reference[:, :2].mean(axis=0)
    a, b = poses[:, :2] - centre, reference[:, :2] - to
    turn = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
    motion = compose_poses(np.array([[*to, turn]]), inverse_poses(np.array([[*centre, 0.0]])))
    return compose_poses(np.repeat(motion, len(poses), axis=0), poses)


def localised(scans: list[Scan], poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Localise held-out scans against the map of the others.

    Args:
        scans: All scans; every fifth is held out.
        poses: Their poses (N, 3); those of held-out ones are where localisation begins.

    Returns:
        Each held-out scan's mean log-likelihood of a ray (nats), and how far localising moved it (m).
    """
    items = [(scan, Pose2D(*pose)) for scan, pose in zip(scans, poses.tolist(), strict=True)]
    frame = frame_of(items, CSAIL_RESOLUTION)
    training = [item for number, item in enumerate(items) if number % EVERY]
    mapper = ForwardMapper(CSAIL_RESOLUTION, frame.bounds)
    for scan, pose in training:
        mapper.accumulate(scan, pose)
    fit = mapper.fit()
    level, noise = fit_level(fit.stopping, fit.frame, rays_of(training))
    likelihood = ScanLikelihood.of(fit, fit.noise)
    nats, moved = [], []
    for scan, start in items[::EVERY]:
        pose = localise(likelihood, scan, start)
        nats.append(level.expect(rays_of([(scan, pose)]), noise)[1].mean_log_likelihood)
        moved.append(math.hypot(pose.x - start.x, pose.y - start.y))
    return np.array(nats), np.array(moved)


def localise(likelihood: ScanLikelihood, scan: Scan, start: Pose2D) -> Pose2D:
    """Return the pose at which a scan fits a map best, from coarse to fine."""
    rays = ScanRays.from_pieces([(scan, start)], start, len(scan.ranges))
    pose, nothing = np.array([start.x, start.y, start.theta]), np.zeros(3)
    for scale in LOCALISATION_NOISE:
        for _ in range(LOCALISATION_ROUNDS):
            pose, _ = maximize_pose(likelihood, rays, nothing, pose, pose, MATCHING.damping_information, scale)
    return Pose2D(*pose.tolist())
