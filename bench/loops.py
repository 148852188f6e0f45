"""Loops in simulated buildings: whether they close, and whether places that look alike are mistaken for each other.

python -m bench.loops [--seeds N] [--update docs/poses.md]
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.maps import update
from prim.arrays import FloatArray
from prim.log import open_log
from prim.scan import PosedScan
from prim.se2 import Pose2D, relative_poses, wrap_angles
from prim.world import Wall, World
from recorder.odometry import Odometry, OdometryNoise
from recorder.sensors import Lidar
from replay.poses.pose_provider import PoseProvider
from replay.poses.scan_registration import range_noise
from replay.poses.tracking.options import DEFAULTS as TRACKING
from replay.poses.tracking.points import moved, scan_points
from replay.poses.tracking.scan_tracker import ScanTrack, ScanTracker, track
from replay.scans.posed_scans import PosedScans, ScanLog
from replay.scans.selection import Selection

NOISE = OdometryNoise(0.15, math.radians(6))
"""Three times as bad as the recorder's default."""

LIDAR = Lidar(rays=360, range_min=0.1, range_max=10.0, noise_std=0.02)
STEP, TURN = 0.1, math.radians(6)
"""From one scan to the next, m or rad."""

WIDTH = 2.0
"""Of corridors (m)."""

PIXEL, PICTURE = 0.1, 700
"""Of pictures: M a pixel, and the least side."""

CHI_SQUARE_95 = 7.815
"""Of three degrees of freedom."""

WRONG = 0.5, math.radians(5)
"""Loops that are off by more than this (m, rad) are wrong."""


class Building(NamedTuple):
    """Walls, and the way through them: points (N, 2) in m."""

    walls: list[Wall]
    way: list[tuple[float, float]]


def niched(
    begin: tuple[float, float], end: tuple[float, float], niches: list[tuple[float, float, float]]
) -> list[Wall]:
    """Return a wall with niches to its right: where they begin, their width and depth (m)."""
    (x0, y0), (x1, y1) = begin, end
    length = math.hypot(x1 - x0, y1 - y0)
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    line = [(0.0, 0.0)]
    for start, width, depth in niches:
        line += [(start, 0.0), (start, depth), (start + width, depth), (start + width, 0.0)]
    line.append((length, 0.0))
    corners = [(x0 + a * ux + d * uy, y0 + a * uy - d * ux) for a, d in line]
    return [(*one, *other) for one, other in itertools.pairwise(corners)]


def random_niches(length: float, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    niches, at = [], rng.uniform(1.5, 3)
    while at < length - 3:
        width = rng.uniform(0.4, 1.6)
        niches.append((at, width, rng.uniform(0.1, 0.6)))
        at += width + rng.uniform(0.8, 4)
    return niches


def even_niches(length: float, spacing: float) -> list[tuple[float, float, float]]:
    return [(float(at), 1.0, 0.2) for at in np.arange(spacing / 2, length - 1.5, spacing)]


def ring(
    rng: np.random.Generator, niches: Callable[[float], list[tuple[float, float, float]]], laps: float
) -> Building:
    """Corridors round a block of 30 m by 20 m, and a way round it."""
    out, w = 0.5 * WIDTH, 30.0
    h = 20.0
    outer = [(-out, -out), (-out, h + out), (w + out, h + out), (w + out, -out)]
    inner = [(out, out), (w - out, out), (w - out, h - out), (out, h - out)]
    walls = []
    for corners in (outer, inner):
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
            walls += niched(b, a, niches(math.dist(a, b)))
    corners = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)]
    begin = (rng.uniform(4, 26), 0.0)
    way = [begin, *corners[1:], corners[0]]
    lap = 2 * (w + h)
    rest = (laps - 1) * lap + begin[0]
    if rest > 0:
        way.append((min(rest, w), 0.0))
    return Building(walls, way)


def block(rng: np.random.Generator) -> Building:
    """A loop of 100 m, and some metres of it again."""
    return ring(rng, lambda length: random_niches(length, rng), 1.1)


def even_block(rng: np.random.Generator) -> Building:
    """The same, whose sides and corners look alike."""
    return ring(rng, lambda length: even_niches(length, 4.0), 1.2)


def open_block(rng: np.random.Generator) -> Building:
    """Three sides of a block, whose sides and corners look alike: no loop."""
    whole = ring(rng, lambda length: even_niches(length, 4.0), 1.0)
    return Building(whole.walls, [(15.0, 0.0), (30.0, 0.0), (30.0, 20.0), (0.0, 20.0), (0.0, rng.uniform(6, 9))])


def corridor(rng: np.random.Generator, spacing: float | None) -> Building:
    """A straight corridor, with doors that look alike or without."""
    length = float(rng.uniform(50, 70))
    doors = even_niches(length, spacing) if spacing else []
    half = WIDTH / 2
    walls = niched((0, -half), (length, -half), doors) + niched((length, half), (0, half), doors)
    walls += [(0, -half, 0, half), (length, -half, length, half)]
    return Building(walls, [(1.0, 0.0), (length - 1.5, 0.0)])


def rooms(rng: np.random.Generator) -> Building:
    """A corridor with rooms that look alike, each of which is entered."""
    pitch, count, half = float(rng.uniform(4.5, 6)), 8, WIDTH / 2
    length = pitch * count
    walls: list[Wall] = [(0, -half, length, -half), (0, -half, 0, half), (length, -half, length, half)]
    way = [(0.5, 0.0)]
    for k in range(count):
        x, door = k * pitch, k * pitch + pitch / 2
        walls += [(x, half, door - 0.6, half), (door + 0.6, half, x + pitch, half)]
        walls += [(x, half, x, half + 4), (x, half + 4, x + pitch, half + 4), (x + pitch, half, x + pitch, half + 4)]
        walls += [(x + 0.8, half + 4, x + 0.8, half + 3), (x + 0.8, half + 3, x, half + 3)]
        way += [(door, 0.0), (door, half + 2.0), (door, 0.0)]
    return Building(walls, [*way, (length - 1.0, 0.0)])


def serpentine(rng: np.random.Generator) -> Building:
    """Two parallel corridors that look alike, joined at one end: up the one, down the other."""
    length, apart, half = float(rng.uniform(25, 35)), float(rng.uniform(5, 9)), WIDTH / 2
    doors = even_niches(length, 4.0)
    walls = niched((0, -half), (length + half, -half), doors) + niched((length - half, half), (0, half), doors)
    walls += niched((0, apart - half), (length - half, apart - half), doors)
    walls += niched((length + half, apart + half), (0, apart + half), doors)
    walls += [(0, -half, 0, half), (0, apart - half, 0, apart + half)]
    walls += [(length + half, -half, length + half, apart + half), (length - half, half, length - half, apart - half)]
    return Building(walls, [(1.0, 0.0), (length, 0.0), (length, apart), (1.0, apart)])


BUILDINGS: dict[str, Callable[[np.random.Generator], Building]] = {
    "a loop of 100 m": block,
    "the same, sides alike": even_block,
    "corridor without doors": lambda rng: corridor(rng, None),
    "corridor, doors alike": lambda rng: corridor(rng, 4.0),
    "rooms alike": rooms,
    "parallel corridors alike": serpentine,
    "three sides alike": open_block,
}


WITH_LOOPS = ("a loop of 100 m", "the same, sides alike")


def driven(way: list[tuple[float, float]]) -> FloatArray:
    """Return poses (N, 3) along a way, with turns on the spot."""
    poses: list[tuple[float, float, float]] = []
    heading = math.atan2(way[1][1] - way[0][1], way[1][0] - way[0][0])
    for (x0, y0), (x1, y1) in itertools.pairwise(way):
        length, to = math.hypot(x1 - x0, y1 - y0), math.atan2(y1 - y0, x1 - x0)
        turn = float(wrap_angles(np.array([to - heading]))[0])
        steps = math.ceil(abs(turn) / TURN)
        poses += [(x0, y0, heading + turn * k / steps) for k in range(steps)]
        heading += turn
        count = math.ceil(length / STEP)
        poses += [(x0 + (x1 - x0) * k / count, y0 + (y1 - y0) * k / count, heading) for k in range(count)]
    return np.array(poses)


def measured(building: Building, rng: np.random.Generator) -> tuple[list[PosedScan], FloatArray, FloatArray]:
    """Return scans along the way, odometry (N, 3) and the true poses (N, 3) in the frame of the first one."""
    true = driven(building.way)
    low = np.array(building.walls).reshape(-1, 2).min(axis=0)
    high = np.array(building.walls).reshape(-1, 2).max(axis=0)
    size = 2 * float(np.abs([low, high]).max()) + 2
    world, odometry = World((size, size), (), tuple(building.walls)), Odometry(NOISE, rng)
    scans, by_odometry, before = [], [], true[0]
    for k, pose in enumerate(true):
        at = Pose2D(*pose.tolist())
        scan = LIDAR.measure(world, at, (k + 1) * 2 * 10**8, 0.2, rng)
        scans.append(PosedScan(k, scan, at, [(scan, at)]))
        travelled = math.hypot(*(pose - before)[:2]) + abs(pose[2] - before[2])
        odometry.update(at, travelled)
        by_odometry.append((odometry.pose.x, odometry.pose.y, odometry.pose.theta))
        before = pose
    return scans, np.array(by_odometry), relative_poses(np.repeat(true[:1], len(true), axis=0), true)


def wrong_loops(found: ScanTrack, true: FloatArray) -> int:
    """Count loops that are off by more than the scans of the same place may be."""
    if found.closed is None or not found.closed.loops:
        return 0
    frames = np.array(found.keyframes)
    first, last = (frames[[getattr(loop, end) for loop in found.closed.loops]] for end in ("first", "last"))
    motions = np.array([loop.motion for loop in found.closed.loops])
    apart = motions - relative_poses(true[first], true[last])
    is_far, is_turned = np.hypot(apart[:, 0], apart[:, 1]) > WRONG[0], np.abs(wrap_angles(apart[:, 2])) > WRONG[1]
    return int((is_far | is_turned).sum())


def held_share(found: ScanTrack, true: FloatArray) -> float:
    """Return the share of poses whose errors lie within their 95 % ellipsoids."""
    assert found.errors is not None
    apart = found.poses - true
    apart[:, 2] = wrap_angles(apart[:, 2])
    information = np.linalg.inv(found.errors.since_first()[1:])
    return float((np.einsum("ni,nij,nj->n", apart[1:], information, apart[1:]) < CHI_SQUARE_95).mean())


class Result(NamedTuple):
    """What tracking a building gave.

    Attributes:
        rmse: Of the poses (m).
        held: The share of poses whose errors their covariances hold with a probability of 95 %.
        loops: Loops that were closed.
        wrong: Wrong ones among their keyframes.
        rejected: Keyframes that were rejected.
        seconds: CPU time.
    """

    rmse: float
    held: float
    loops: int
    wrong: int
    rejected: int
    seconds: float


def tracked(name: str, seed: int, with_odometry: bool) -> Result:
    """Track a simulated building."""
    rng = np.random.default_rng(seed)
    scans, odometry, true = measured(BUILDINGS[name](rng), rng)
    start = time.process_time()
    found = track(scans, odometry if with_odometry else None)
    seconds = time.process_time() - start
    away = np.hypot(*(found.poses - true)[:, :2].T)
    closed = found.closed
    return Result(
        float(np.sqrt(np.mean(away**2))),
        held_share(found, true),
        closed.closed if closed else 0,
        wrong_loops(found, true),
        sum(closed.rejected.values()) if closed else 0,
        seconds,
    )


def rows(seeds: int) -> Iterator[str]:
    """Yield the table's rows as they are measured."""
    columns = "logs", "RMSE, mm: mean, worst", "held by 95 %", "loops", "wrong keyframes", "rejected ones", "CPU, s"
    yield "| building | poses | " + " | ".join(columns) + " |"
    yield "|---|---|" + "---:|" * len(columns)
    for name, (label, known) in itertools.product(BUILDINGS, (("odometry", True), ("scans alone", False))):
        count = seeds if name in WITH_LOOPS else max(seeds // (len(BUILDINGS) - len(WITH_LOOPS)), 1)
        results = [tracked(name, seed, known) for seed in range(count)]
        rmse, held, loops, wrong, rejected, seconds = (np.array(column) for column in zip(*results, strict=True))
        errors = f"{1000 * rmse.mean():.0f}, {1000 * rmse.max():.0f} | {100 * held.mean():.0f} %"
        counts = f"{loops.mean():.1f} | {wrong.sum()} | {rejected.mean():.1f} | {seconds.mean():.1f}"
        yield f"| {name} | {label} | {count} | {errors} | {counts} |"


def picture(path: Path, log_path: Path) -> None:
    """Draw a building's points by tracking its scans alone, before loops are closed and after."""
    with open_log(log_path) as log:
        scans = ScanLog(log, Selection())
        poses = replace(PoseProvider(log).laser_poses(scans.times, "odom"), end_poses=None)
        held = list(PosedScans(scans, poses))
    noise_std = range_noise([posed.scan for posed in held])
    points = [scan_points(posed, noise_std, TRACKING.points) for posed in held]
    tracker = ScanTracker(points, np.array([posed.scan.stamp for posed in held]), None, TRACKING)
    tracker.run()
    tracker.settle()
    before = tracker.poses.copy()
    tracker.close_loops()
    drawn = [drawing([points[k] for k in tracker.keyframes], of[tracker.keyframes]) for of in (before, tracker.poses)]
    cv2.imwrite(str(path), np.hstack(drawn))


def drawing(points: list[FloatArray], poses: FloatArray) -> NDArray[np.uint8]:
    """Return a picture of points and of the way, 10 cm a pixel."""
    world = np.vstack([moved(*pair)[:, :2] for pair in zip(points, poses, strict=True)])
    low, high = np.percentile(world, [0.2, 99.8], axis=0)
    cols, rows = np.ceil((high - low) / PIXEL).astype(int) + 1
    drawn = np.full((rows, cols, 3), 255, np.uint8)
    for places, colour in ((world, (0, 0, 0)), (poses[:, :2], (60, 60, 230))):
        col, row = np.floor((places - low) / PIXEL).astype(int).T
        inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
        drawn[rows - 1 - row[inside], col[inside]] = colour
    side = PICTURE - np.array(drawn.shape[:2])
    return cv2.copyMakeBorder(
        drawn, 0, max(int(side[0]), 0), 0, max(int(side[1]), 0), cv2.BORDER_CONSTANT, value=(255,) * 3
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--update", type=Path, help="the document that gets the table")
    parser.add_argument(
        "--picture", type=Path, help="draws the CSAIL floor before and after loops here, and nothing else"
    )
    parser.add_argument("--log", type=Path, default=Path("../shared/data/csail_raw.mcap"))
    options = parser.parse_args()
    if options.picture:
        picture(options.picture, options.log)
        return
    lines = []
    for line in rows(options.seeds):
        print(line, flush=True)
        lines.append(line)
    if options.update:
        update(options.update, "loops", "\n".join(lines))


if __name__ == "__main__":
    main()
