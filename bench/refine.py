"""Evaluation of refinement on recorded sessions: errors, their consistency and lower bounds, kinds, time, baselines.

    python -m bench.refine [--sessions 200] [--mapper forward] [--noise 0.05 0.25 0.5] [--update docs/refine.md]

Sessions that no network was trained on (seeds from 40000), 2 x 2 m, warped, 500 rays, exact poses; detections are the
networks'. No outlier is left out. mAP is that of the bounding boxes of refined outlines, each counted as every kind
with that kind's posterior probability. Baselines: OpenCV's contours on the same maps (bench/classical.py); and fits
of the true kind to the end points within 10 cm of each true outline: circles by RANSAC and least squares, rectangles
as the box of minimum area around the points between the 2nd and 98th percentiles.
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
from bench.limit import NORMAL_MEDIAN, bounds, ratio
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
from prim.se2 import angle_difference
from prim.shapes import Kind, Primitive, angle_error
from recorder.sensors import Lidar
from recorder.session import SessionOptions

FIRST_SEED = 40_000
ARENA = np.array([(-1, -1, 1, -1), (1, -1, 1, 1), (1, 1, -1, 1), (-1, 1, -1, -1)], float)
"""The walls (4, 4) of all sessions: x and y (m) of both ends."""

END_POINT_DISTANCE = 0.1
"""End points this near (m) to a true outline are fitted."""

MIN_END_POINTS = 20


@dataclass(frozen=True)
class Estimate:
    """One true primitive and what was estimated of it.

    Attributes:
        kind: The true kind.
        located: Whether a detection of any kind overlaps it (outline IoU of at least 0.5).
        found: Whether that one has the true kind; what follows holds of found ones, else it is empty.
        errors: Errors (m, rad) in the order of Kind.parameters.
        stds: Their estimated standard deviations.
        unbiased: Their lower bounds for unbiased estimators (Chapman and Robbins).
        limits: Their lower bounds for any estimator (Weiss and Weinstein).
        position: Distance of the centroids (m).
        angle: Error of the angle (rad); None where there is none.
        sizes: Errors (m) of width and height.
        opencv: Errors (m) of position and size by OpenCV's contours; None where these have not found it.
        points: The same by a fit to the end points; None where there is none.
    """

    kind: Kind
    located: bool
    found: bool
    errors: tuple[float, ...] = ()
    stds: tuple[float, ...] = ()
    unbiased: tuple[float, ...] = ()
    limits: tuple[float, ...] = ()
    position: float = math.nan
    angle: float | None = None
    sizes: tuple[float, float] = (math.nan, math.nan)
    opencv: tuple[float, float] | None = None
    points: tuple[float, float] | None = None


@dataclass(frozen=True)
class Outcome:
    """The evaluation of one session.

    Attributes:
        primitives: Of each true primitive.
        detections: Number of refined detections.
        scored: Their boxes, for mAP.
        network: Numbers of true positives and of detections of the networks alone.
        opencv: The same of OpenCV's contours.
        refine_s: Run time of refinement (s).
    """

    primitives: tuple[Estimate, ...]
    detections: int
    scored: ScoredBoxes
    network: tuple[int, int]
    opencv: tuple[int, int]
    refine_s: float


def outcome(seed: int, noise_std: float, mapper: str) -> Outcome:
    """Record a session, map it, detect, refine, and evaluate all against the ground truth.

    Args:
        seed: The session's seed.
        noise_std: Standard deviation of the range noise (m).
        mapper: Name of the mapper.

    Returns:
        The evaluation.
    """
    session = recorded(SessionOptions(seed=seed, lidar=Lidar(noise_std=noise_std)))
    session_mapper = make_mapper(mapper, 0.01, session.frame.bounds)
    for scan, pose in session.scans:
        session_mapper.accumulate(scan, pose)
    grid = session_mapper.finish()
    detector = Detector.load(SHIPPED / mapper, mapper, 1)
    detections = detector.detect(grid)
    began = time.perf_counter()
    refined, _ = refine_detections(detections, session.scans, grid, None, 1)
    ended = time.perf_counter()
    primitives = [detection.primitive for detection in refined.found]
    stds = [dict(detection.std or {}) for detection in refined.found]
    pairs = {pair.truth: pair for pair in match_primitives(primitives, session.primitives)}
    baseline = classical.detect(grid)
    matched = {pair.truth: pair for pair in match_primitives(baseline, session.primitives) if pair.found}
    limits = bounds(session.scans, session.primitives, ARENA, max(noise_std, 1e-3))
    rows = []
    for k, true in enumerate(session.primitives):
        pair = pairs.get(k)
        opencv = (matched[k].position, (matched[k].width + matched[k].height) / 2) if k in matched else None
        if pair is None or not pair.found:
            located = pair is not None and pair.iou >= 0.5
            rows.append(Estimate(true.kind, located, False, opencv=opencv))
            continue
        estimate, names = primitives[pair.detection], true.kind.parameters
        rows.append(
            Estimate(
                true.kind,
                True,
                True,
                parameter_errors(estimate, true),
                tuple(stds[pair.detection][name] for name in names),
                tuple(limits[k].chapman_robbins.tolist()),
                tuple(limits[k].weiss_weinstein.tolist()),
                pair.position,
                angle_error(estimate, true),
                (pair.width, pair.height),
                opencv,
                end_point_errors(session, true),
            )
        )
    networks = match_primitives([detection.primitive for detection in detections.found], session.primitives)
    return Outcome(
        tuple(rows),
        len(primitives),
        scored_primitives(refined, session.primitives),
        (sum(pair.found for pair in networks), len(detections.found)),
        (len(matched), len(baseline)),
        ended - began,
    )


def parameter_errors(estimate: Primitive, true: Primitive) -> tuple[float, ...]:
    """Compute the errors of all parameters.

    Args:
        estimate: The estimate.
        true: The true primitive, of the same kind.

    Returns:
        Errors (m, rad) in the order of Kind.parameters, the angle's modulo the true shape's symmetry.
    """
    angle: tuple[float, ...] = ()
    if estimate.theta is not None and true.theta is not None:
        angle = (0.0 if true.symmetry is None else angle_difference(estimate.theta, true.theta, true.symmetry),)
    sizes = tuple(a - b for a, b in zip(estimate.size, true.size, strict=True))
    return (estimate.x - true.x, estimate.y - true.y, *angle, *sizes)


def end_point_errors(session: Session, true: Primitive) -> tuple[float, float] | None:
    """Fit a circle or rectangle to the end points near a true primitive.

    Args:
        session: The session.
        true: The primitive.

    Returns:
        Errors (m) of position and size; None for other kinds, or with too few points.
    """
    if true.kind not in (Kind.CIRCLE, Kind.RECTANGLE, Kind.SQUARE):
        return None
    points = np.concatenate([scan.points(pose) for scan, pose in session.scans])
    points = points[is_within(true, points, END_POINT_DISTANCE)]
    if len(points) < MIN_END_POINTS:
        return None
    if true.kind is Kind.CIRCLE:
        x, y, radius = ransac_circle(points)
        return math.hypot(x - true.x, y - true.y), abs(radius - true.size[0])
    x, y, width, height = min_area_box(points)
    sizes = true.width_height
    return math.hypot(x - true.x, y - true.y), (abs(width - sizes[0]) + abs(height - sizes[1])) / 2


def ransac_circle(points: FloatArray, within: float = 0.02, trials: int = 100) -> tuple[float, float, float]:
    """Fit a circle by RANSAC and least squares.

    Args:
        points: Points (N, 2) in m.
        within: Largest distance (m) of inliers.
        trials: Number of hypotheses.

    Returns:
        The centre's x and y, and the radius (m).
    """
    rng = np.random.default_rng(0)
    best = np.zeros(len(points), bool)
    for _ in range(trials):
        x, y, radius = least_squares_circle(points[rng.choice(len(points), 3, replace=False)])
        near = np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius) < within
        if np.count_nonzero(near) > np.count_nonzero(best):
            best = near
    return least_squares_circle(points[best] if np.count_nonzero(best) > 3 else points)


def least_squares_circle(points: FloatArray) -> tuple[float, float, float]:
    """Fit a circle to points (N, 2) by linear least squares; return the centre's x and y, and the radius (m)."""
    a = np.column_stack((points, np.ones(len(points))))
    c = np.linalg.lstsq(a, -(points**2).sum(axis=1), rcond=None)[0]
    x, y = -c[0] / 2, -c[1] / 2
    return float(x), float(y), math.sqrt(max(x * x + y * y - c[2], 1e-9))


def min_area_box(points: FloatArray, cut: float = 2.0) -> tuple[float, float, float, float]:
    """Find the rectangle of minimum area around points, over angles in steps of a degree.

    Args:
        points: Points (N, 2) in m.
        cut: Percentage of the points that is left out at each end of both axes.

    Returns:
        The centre's x and y, and the longer and the shorter side (m).
    """
    best = (math.inf, 0.0, 0.0, 0.0, 0.0)
    for angle in np.radians(np.arange(0, 90)):
        axes = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        low, high = np.percentile(points @ axes, [cut, 100 - cut], axis=0)
        sides, middle = high - low, axes @ ((low + high) / 2)
        if sides.prod() < best[0]:
            best = (float(sides.prod()), float(middle[0]), float(middle[1]), float(sides.max()), float(sides.min()))
    return best[1:]


def quality(name: str, outcomes: Sequence[Outcome]) -> str:
    """Return a row of the table of errors.

    Args:
        name: Its first cell.
        outcomes: The sessions.

    Returns:
        F1 of networks, OpenCV and refinement, mAP, kinds, errors, normalised errors, and run time.
    """
    rows = [row for session in outcomes for row in session.primitives]
    found = [row for row in rows if row.found]
    located = [row for row in rows if row.located]
    hits, true = len(found), len(rows)

    def f1(true_positives: int, detected: int) -> str:
        return f"{2 * true_positives / max(detected + true, 1):.3f}"

    if not found:
        return f"| {name} | nothing found" + " |" * 10
    z = np.concatenate([np.divide(row.errors, row.stds) for row in found])
    angles = [row.angle for row in found if row.angle is not None]
    sizes = 1000 * np.array([row.sizes for row in found])
    position = 1000 * np.array([row.position for row in found])
    scores = score_boxes([session.scored for session in outcomes])["all"]
    seconds = [session.refine_s / len(session.primitives) for session in outcomes if session.primitives]
    cells = (
        name,
        f1(sum(session.network[0] for session in outcomes), sum(session.network[1] for session in outcomes)),
        f1(sum(session.opencv[0] for session in outcomes), sum(session.opencv[1] for session in outcomes)),
        f1(hits, sum(session.detections for session in outcomes)),
        f"{scores.map50:.3f} / {scores.map50_95:.3f}",
        f"{hits / max(len(located), 1):.1%}",
        f"{position.mean():.2f} / {np.median(position):.2f}",
        f"{sizes.mean():.2f} / {np.median(sizes):.2f}",
        f"{np.degrees(np.mean(angles)):.2f} / {np.degrees(np.median(angles)):.2f}",
        f"{math.sqrt(np.mean(z**2)):.2f} / {np.median(np.abs(z)) / NORMAL_MEDIAN:.2f}",
        f"{1000 * np.median(seconds):.0f}",
    )
    return f"| {' | '.join(cells)} |"


def limits_table(noise_std: float, outcomes: Sequence[Outcome]) -> list[str]:
    """Return the rows of the ratios of errors to their lower bounds.

    Args:
        noise_std: Standard deviation of the range noise (m).
        outcomes: The sessions.

    Returns:
        A row for each kind.
    """
    lines = []
    for kind in Kind:
        found = [row for session in outcomes for row in session.primitives if row.found and row.kind is kind]
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


def baselines_row(noise_std: float, outcomes: Sequence[Outcome]) -> str:
    """Return a row of median errors of position and size beside those of each baseline.

    Args:
        noise_std: Standard deviation of the range noise (m).
        outcomes: The sessions.

    Returns:
        The row; each pair of errors is over the primitives that both have found.
    """

    def pair(rows: Sequence[Estimate], errors: Sequence[tuple[float, float]]) -> str:
        if not rows:
            return "– | – | –"
        ours = np.median([(row.position, sum(row.sizes) / 2) for row in rows], axis=0)
        theirs = np.median(errors, axis=0)
        factor = "–" if not ours.all() else f"{theirs[0] / ours[0]:.0f} × / {theirs[1] / ours[1]:.0f} ×"
        first, second = 1000 * ours, 1000 * theirs
        return f"{first[0]:.2f} / {first[1]:.2f} | {second[0]:.1f} / {second[1]:.1f} | {factor}"

    found = [row for session in outcomes for row in session.primitives if row.found]
    opencv = [row for row in found if row.opencv]
    points = [row for row in found if row.points]
    contours = pair(opencv, [row.opencv for row in opencv if row.opencv])
    fits = pair(points, [row.points for row in points if row.points])
    return f"| {1000 * noise_std:g} mm | {contours} | {fits} |"


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
    """Return the first table without the columns that only docs/refine.md explains."""
    rows = [line.split("|")[1:-1] for line in content.split("\n\n")[0].splitlines()]
    chosen = [0, 1, 2, 3, 6, 7, 8, 9]
    return "\n".join("|" + "|".join(row[k] for k in chosen) + "|" for row in rows)


HEAD = [
    "F1: networks | OpenCV | **refined** | mAP50 / 50-95 | kind | position, mm | size, mm | angle, ° | z | ms |",
    "|" + "---:|" * 10,
]


def sessions(pool: ProcessPoolExecutor, options: argparse.Namespace, noise_std: float) -> list[Outcome]:
    """Evaluate all sessions at one noise level.

    Args:
        pool: The processes.
        options: The command's options.
        noise_std: Standard deviation of the range noise (m).

    Returns:
        The evaluations.
    """
    seeds = range(options.first_seed, options.first_seed + options.sessions)
    return list(pool.map(partial(outcome, noise_std=noise_std, mapper=options.mapper), seeds))


def tables(pool: ProcessPoolExecutor, options: argparse.Namespace) -> str:
    """Return the tables of errors, of their ratios to the lower bounds, and of the baselines.

    Args:
        pool: The processes.
        options: The command's options.

    Returns:
        The tables, separated by empty lines.
    """
    errors = ["| noise | " + HEAD[0], "|---" + HEAD[1]]
    limits = ["| noise | kind | found | x | y | angle | size | size 2 |", "|---|---|" + "---:|" * 6]
    baselines = [
        "| noise | ours, mm | OpenCV, mm | factor | ours, mm | end points, mm | factor |",
        "|---|" + "---:|" * 6,
    ]
    for noise_std in options.noise:
        outcomes = sessions(pool, options, noise_std)
        errors.append(quality(f"{1000 * noise_std:g} mm", outcomes))
        limits += limits_table(noise_std, outcomes)
        baselines.append(baselines_row(noise_std, outcomes))
        print(errors[-1], *limits[-5:], baselines[-1], sep="\n", flush=True)
    return "\n".join([*errors, "", *limits, "", *baselines])


if __name__ == "__main__":
    main()
