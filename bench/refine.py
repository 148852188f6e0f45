"""Refinement on recorded sessions, from real detections: errors, error bars, the limit, kinds, time, and peers.

    python -m bench.refine [--sessions 200] [--mapper forward] [--noise 0.05 0.25 0.5] [--update docs/refine.md]

Sessions that no network was trained on (seeds from 40000), 2 x 2 m, warped, 500 rays, poses exact. All that is found
counts, no outlier is left out. mAP is of the boxes around refined outlines, as every kind by its chance. Peers:
OpenCV's contours on the same maps (bench/classical.py), and least squares on the end points within 10 cm of each true
outline, of the true kind: circles (RANSAC, then least squares) and
rectangles (the box of least area around them, ends cut by 2 %). OpenCV comes with the extra [train].
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from bench import classical
from bench.limit import bounds, ratio
from bench.maps import update
from bench.sessions import Session, recorded
from detect.detector import Detector
from detect.evaluation.box_metrics import score_boxes
from detect.evaluation.sessions import scored_primitives
from detect.networks.weights import SHIPPED
from detect.refinement.map_cells import is_within
from detect.refinement.refine import refine_detections
from detect.training.matches import ScoredBoxes
from mapping.mapper import make_mapper
from prim.arrays import FloatArray
from prim.metrics import match_primitives
from prim.shapes import Kind, Primitive, angle_difference, angle_error
from recorder.sensors import Lidar
from recorder.session import SessionOptions

FIRST_SEED = 40_000
ARENA = np.array([(-1, -1, 1, -1), (1, -1, 1, 1), (1, 1, -1, 1), (-1, 1, -1, -1)], float)


@dataclass(frozen=True)
class Found:
    """One true primitive: whether it was found, its kind right where it was seen, errors (m, rad) of the kind's own
    parameters, their standard deviations as told, the bounds of Chapman and Robbins (for unbiased estimates) and of
    Weiss and Weinstein (the limit of any); and the peers' mean errors (m) of place and size.
    """

    kind: Kind
    seen: bool
    right: bool
    found: bool
    errors: tuple[float, ...] = ()
    stds: tuple[float, ...] = ()
    unbiased: tuple[float, ...] = ()
    limits: tuple[float, ...] = ()
    place: float = math.nan
    angle: float | None = None
    sizes: tuple[float, float] = (math.nan, math.nan)
    opencv: tuple[float, float] | None = None
    points: tuple[float, float] | None = None


@dataclass(frozen=True)
class Outcome:
    """One session: its primitives, how many were found in all by whom, the seconds of refinement."""

    primitives: tuple[Found, ...]
    detections: int
    scored: ScoredBoxes
    network: tuple[int, int]
    opencv: tuple[int, int]
    refine_s: float


def outcome(seed: int, noise_std: float, mapper: str) -> Outcome:
    """Records a session, maps it, detects, refines, and holds all against the truth."""
    session = recorded(SessionOptions(seed=seed, lidar=Lidar(noise_std=noise_std)))
    made = make_mapper(mapper, 0.01, session.frame.bounds)
    for scan, pose in session.scans:
        made.accumulate(scan, pose)
    grid = made.finish()
    detector = Detector.load(SHIPPED / mapper, mapper, 1)
    detections = detector.detect(grid)
    between = time.perf_counter()
    refined, _ = refine_detections(detections, session.scans, grid, None, 1)
    ended = time.perf_counter()
    primitives = [one.primitive for one in refined.found]
    stds = [dict(one.std or {}) for one in refined.found]
    pairs = {pair.truth: pair for pair in match_primitives(primitives, session.primitives)}
    peer = classical.detect(grid)
    peers = {pair.truth: pair for pair in match_primitives(peer, session.primitives) if pair.found}
    limits = bounds(session.scans, session.primitives, ARENA, max(noise_std, 1e-3))
    rows = []
    for k, true in enumerate(session.primitives):
        pair = pairs.get(k)
        opencv = (peers[k].position, (peers[k].width + peers[k].height) / 2) if k in peers else None
        if pair is None or not pair.found:
            seen = pair is not None and pair.iou >= 0.5
            rows.append(Found(true.kind, seen, False, False, opencv=opencv))
            continue
        one, names = primitives[pair.detection], true.kind.parameters
        rows.append(
            Found(
                true.kind,
                True,
                True,
                True,
                own_errors(one, true),
                tuple(stds[pair.detection][name] for name in names),
                tuple(limits[k].chapman_robbins.tolist()),
                tuple(limits[k].weiss_weinstein.tolist()),
                pair.position,
                angle_error(one, true),
                (pair.width, pair.height),
                opencv,
                end_points(session, true),
            )
        )
    networks = match_primitives([one.primitive for one in detections.found], session.primitives)
    return Outcome(
        tuple(rows),
        len(primitives),
        scored_primitives(refined, session.primitives),
        (sum(pair.found for pair in networks), len(detections.found)),
        (len(peers), len(peer)),
        ended - between,
    )


def own_errors(one: Primitive, true: Primitive) -> tuple[float, ...]:
    """Errors of a kind's own parameters, the angle's modulo the shape's symmetry."""
    turn: tuple[float, ...] = ()
    if one.theta is not None and true.theta is not None:
        turn = (0.0 if true.symmetry is None else angle_difference(one.theta, true.theta, true.symmetry),)
    sizes = tuple(a - b for a, b in zip(one.size, true.size, strict=True))
    return (one.x - true.x, one.y - true.y, *turn, *sizes)


def end_points(session: Session, true: Primitive) -> tuple[float, float] | None:
    """Errors of place and size (m) of a circle or rectangle that is fitted to the end points near it."""
    if true.kind not in (Kind.CIRCLE, Kind.RECTANGLE, Kind.SQUARE):
        return None
    points = np.concatenate([scan.points(pose) for scan, pose in session.scans])
    points = points[is_within(true, points, 0.1)]
    if len(points) < 20:
        return None
    if true.kind is Kind.CIRCLE:
        x, y, radius = ransac_circle(points)
        return math.hypot(x - true.x, y - true.y), abs(radius - true.size[0])
    x, y, width, height = least_box(points)
    sizes = true.width_height
    return math.hypot(x - true.x, y - true.y), (abs(width - sizes[0]) + abs(height - sizes[1])) / 2


def ransac_circle(points: FloatArray, within: float = 0.02, trials: int = 100) -> tuple[float, float, float]:
    """A circle by RANSAC and least squares."""
    rng = np.random.default_rng(0)
    best = np.zeros(len(points), bool)
    for _ in range(trials):
        x, y, radius = least_circle(points[rng.choice(len(points), 3, replace=False)])
        near = np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius) < within
        if np.count_nonzero(near) > np.count_nonzero(best):
            best = near
    return least_circle(points[best] if np.count_nonzero(best) > 3 else points)


def least_circle(points: FloatArray) -> tuple[float, float, float]:
    """A circle by linear least squares."""
    a = np.column_stack((points, np.ones(len(points))))
    c = np.linalg.lstsq(a, -(points**2).sum(axis=1), rcond=None)[0]
    x, y = -c[0] / 2, -c[1] / 2
    return float(x), float(y), math.sqrt(max(x * x + y * y - c[2], 1e-9))


def least_box(points: FloatArray, cut: float = 2.0) -> tuple[float, float, float, float]:
    """The rectangle of least area around points, of every degree of turn; what sticks out most is left out."""
    best = (math.inf, 0.0, 0.0, 0.0, 0.0)
    for turn in np.radians(np.arange(0, 90)):
        axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        low, high = np.percentile(points @ axes, [cut, 100 - cut], axis=0)
        sides, middle = high - low, axes @ ((low + high) / 2)
        if sides.prod() < best[0]:
            best = (float(sides.prod()), float(middle[0]), float(middle[1]), float(sides.max()), float(sides.min()))
    return best[1:]


def quality(name: str, of: Sequence[Outcome]) -> str:
    """One row: F1 of networks, peers and refinement, kinds, errors, error bars, time."""
    rows = [row for one in of for row in one.primitives]
    found = [row for row in rows if row.found]
    seen = [row for row in rows if row.seen]
    hits, there = len(found), len(rows)

    def f1(right: int, all_found: int) -> str:
        return f"{2 * right / max(all_found + there, 1):.3f}"

    if not found:
        return f"| {name} | nothing found" + " |" * 10
    z = np.concatenate([np.divide(row.errors, row.stds) for row in found])
    angles = [row.angle for row in found if row.angle is not None]
    sizes = 1000 * np.array([row.sizes for row in found])
    place = 1000 * np.array([row.place for row in found])
    scores = score_boxes([one.scored for one in of])["all"]
    each = [one.refine_s / len(one.primitives) for one in of if one.primitives]
    cells = (
        name,
        f1(sum(one.network[0] for one in of), sum(one.network[1] for one in of)),
        f1(sum(one.opencv[0] for one in of), sum(one.opencv[1] for one in of)),
        f1(hits, sum(one.detections for one in of)),
        f"{scores.map50:.3f} / {scores.map50_95:.3f}",
        f"{sum(row.right for row in seen) / max(len(seen), 1):.1%}",
        f"{place.mean():.2f} / {np.median(place):.2f}",
        f"{sizes.mean():.2f} / {np.median(sizes):.2f}",
        f"{np.degrees(np.mean(angles)):.2f} / {np.degrees(np.median(angles)):.2f}",
        f"{math.sqrt(np.mean(z**2)):.2f} / {np.median(np.abs(z)) / 0.674:.2f}",
        f"{1000 * np.median(each):.0f}",
    )
    return f"| {' | '.join(cells)} |"


def limits_table(noise_std: float, of: Sequence[Outcome]) -> list[str]:
    """The ratio to the limit of each kind's parameters."""
    lines = []
    for kind in Kind:
        found = [row for one in of for row in one.primitives if row.found and row.kind is kind]
        cells = []
        for name in ("x", "y", "theta", "size", "size 2"):
            sizes = {"size": kind.sizes[0], "size 2": kind.sizes[-1] if len(kind.sizes) > 1 else None}
            key = sizes.get(name, name)
            if key not in kind.parameters:
                cells.append("")
                continue
            at = kind.parameters.index(key)
            errors = [row.errors[at] for row in found]
            factors = (ratio(errors, [getattr(row, name)[at] for row in found]) for name in ("limits", "unbiased"))
            cells.append(" / ".join(f"{factor:.2f}" for factor in factors))
        lines.append(f"| {1000 * noise_std:g} mm | {kind} | {len(found)} | {' | '.join(cells)} |")
    return lines


def peers_table(noise_std: float, of: Sequence[Outcome]) -> str:
    """Median errors of place and size (mm) beside the peers', each over what the peer has too."""

    def pair(rows: Sequence[Found], errors: Sequence[tuple[float, float]]) -> str:
        if not rows:
            return "– | – | –"
        ours = np.median([(row.place, sum(row.sizes) / 2) for row in rows], axis=0)
        theirs = np.median(errors, axis=0)
        factor = "–" if not ours.all() else f"{theirs[0] / ours[0]:.0f} × / {theirs[1] / ours[1]:.0f} ×"
        mine, other = 1000 * ours, 1000 * theirs
        return f"{mine[0]:.2f} / {mine[1]:.2f} | {other[0]:.1f} / {other[1]:.1f} | {factor}"

    found = [row for one in of for row in one.primitives if row.found]
    opencv = [row for row in found if row.opencv]
    points = [row for row in found if row.points]
    cells = pair(opencv, [row.opencv for row in opencv if row.opencv])
    more = pair(points, [row.points for row in points if row.points])
    return f"| {1000 * noise_std:g} mm | {cells} | {more} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--mapper", default="forward")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.05, 0.25, 0.5])
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--update", type=Path, help="the document that gets the tables")
    parser.add_argument("--short", type=Path, help="the document that gets the short one")
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        content = tables(pool, options)
    if options.update:
        update(options.update, f"refine {options.mapper}", content)
    if options.short:
        update(options.short, "refine short", short(content))


def short(content: str) -> str:
    """The first table without what only the long one explains."""
    rows = [line.split("|")[1:-1] for line in content.split("\n\n")[0].splitlines()]
    chosen = [0, 1, 2, 3, 6, 7, 8, 9]
    return "\n".join("|" + "|".join(row[k] for k in chosen) + "|" for row in rows)


HEAD = [
    "F1: networks | OpenCV | **refined** | mAP50 / 50-95 | kind | place, mm | size, mm | angle, ° | z | ms each |",
    "|" + "---:|" * 10,
]


def sessions(pool: ProcessPoolExecutor, options: argparse.Namespace, noise_std: float) -> list[Outcome]:
    """The outcomes of all seeds."""
    seeds = range(options.first_seed, options.first_seed + options.sessions)
    return list(pool.map(partial(outcome, noise_std=noise_std, mapper=options.mapper), seeds))


def tables(pool: ProcessPoolExecutor, options: argparse.Namespace) -> str:
    """Errors, ratios to the limit, and peers at each noise level."""
    errors = ["| noise | " + HEAD[0], "|---" + HEAD[1]]
    limits = ["| noise | kind | found | x | y | angle | size | size 2 |", "|---|---|" + "---:|" * 6]
    peers = ["| noise | ours, mm | OpenCV, mm | factor | ours, mm | end points, mm | factor |", "|---|" + "---:|" * 6]
    for noise_std in options.noise:
        of = sessions(pool, options, noise_std)
        errors.append(quality(f"{1000 * noise_std:g} mm", of))
        limits += limits_table(noise_std, of)
        peers.append(peers_table(noise_std, of))
        print(errors[-1], *limits[-5:], peers[-1], sep="\n", flush=True)
    return "\n".join([*errors, "", *limits, "", *peers])


if __name__ == "__main__":
    main()
