"""Evaluation of refinement on recorded sessions: errors, their consistency and lower bounds, kinds, time, baseline.

    python -m bench.refine [--sessions 200] [--mapper forward] [--noise 0.05 0.25 0.5] [--update docs/refine.md]

Sessions on which nothing was trained or chosen (seeds from 60000), 2 x 2 m, warped, 500 rays, exact poses; detections
are the networks'. No outlier is left out. mAP is that of the boxes around reported outlines (COCO's); weighted mAP
that of detect.evaluation.sessions, a rule of our own. The baseline is OpenCV's contours on the same maps
(bench/classical.py).
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
from bench.sessions import recorded
from detect.detector import Detector
from detect.evaluation.box_metrics import score_boxes
from detect.evaluation.sessions import reported_primitives, scored_primitives
from detect.networks.weights import SHIPPED
from detect.refinement.refine import refine_detections
from detect.training.matches import ScoredBoxes
from mapping.mapper import make_mapper
from prim.choices import MapperName
from prim.metrics import match_primitives
from prim.se2 import angle_difference
from prim.shapes import Kind, Primitive, angle_error
from recorder.sensors import Lidar
from recorder.session import SessionOptions

FIRST_SEED = 60_000
ARENA = np.array([(-1, -1, 1, -1), (1, -1, 1, 1), (1, 1, -1, 1), (-1, 1, -1, -1)], float)
"""The walls (4, 4) of all sessions: x and y (m) of both ends."""


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


@dataclass(frozen=True)
class Outcome:
    """The evaluation of one session.

    Attributes:
        primitives: Of each true primitive.
        detections: Number of refined detections.
        reported: Their boxes, for mAP.
        scored: All fitted candidates' boxes, for weighted mAP.
        network: Numbers of true positives and of detections of the networks alone.
        opencv: The same of OpenCV's contours.
        refine_s: Run time of refinement (s).
    """

    primitives: tuple[Estimate, ...]
    detections: int
    reported: ScoredBoxes
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
            )
        )
    networks = match_primitives([detection.primitive for detection in detections.found], session.primitives)
    return Outcome(
        tuple(rows),
        len(primitives),
        reported_primitives(refined.found, session.primitives),
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
        return f"| {name} | nothing found" + " |" * 11
    z = np.concatenate([np.divide(row.errors, row.stds) for row in found])
    angles = [row.angle for row in found if row.angle is not None]
    sizes = 1000 * np.array([row.sizes for row in found])
    position = 1000 * np.array([row.position for row in found])
    reported = score_boxes([session.reported for session in outcomes])["all"]
    weighted = score_boxes([session.scored for session in outcomes])["all"]
    seconds = [session.refine_s / len(session.primitives) for session in outcomes if session.primitives]
    cells = (
        name,
        f1(sum(session.network[0] for session in outcomes), sum(session.network[1] for session in outcomes)),
        f1(sum(session.opencv[0] for session in outcomes), sum(session.opencv[1] for session in outcomes)),
        f1(hits, sum(session.detections for session in outcomes)),
        f"{reported.map50:.3f} / {reported.map50_95:.3f}",
        f"{weighted.map50:.3f} / {weighted.map50_95:.3f}",
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


def baseline_row(noise_std: float, outcomes: Sequence[Outcome]) -> str:
    """Return a row of median errors of position and size beside those of the baseline.

    Args:
        noise_std: Standard deviation of the range noise (m).
        outcomes: The sessions.

    Returns:
        The row, over the primitives that both have found.
    """
    rows = [row for session in outcomes for row in session.primitives if row.found and row.opencv]
    if not rows:
        return f"| {1000 * noise_std:g} mm" + " | –" * 3 + " |"
    ours = np.median([(row.position, sum(row.sizes) / 2) for row in rows], axis=0)
    theirs = np.median([row.opencv for row in rows if row.opencv], axis=0)
    factor = "–" if not ours.all() else f"{theirs[0] / ours[0]:.0f} × / {theirs[1] / ours[1]:.0f} ×"
    first, second = 1000 * ours, 1000 * theirs
    cells = (f"{first[0]:.2f} / {first[1]:.2f}", f"{second[0]:.1f} / {second[1]:.1f}", factor)
    return f"| {1000 * noise_std:g} mm | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--mapper", type=MapperName, choices=list(MapperName), default=MapperName.FORWARD)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.05, 0.25, 0.5])
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--update", type=Path, help="the document that gets the tables")
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        content = tables(pool, options)
    if options.update:
        update(options.update, f"refine {options.mapper}", content)


HEAD = [
    "F1: networks | OpenCV | **refined** | mAP50 / 50-95 | weighted mAP | kind | "
    "position, mm | size, mm | angle, ° | z | ms |",
    "|" + "---:|" * 11,
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
    """Return the tables of errors, of their ratios to the lower bounds, and of the baseline.

    Args:
        pool: The processes.
        options: The command's options.

    Returns:
        The tables, separated by empty lines.
    """
    errors = ["| noise | " + HEAD[0], "|---" + HEAD[1]]
    limits = ["| noise | kind | found | x | y | angle | size | size 2 |", "|---|---|" + "---:|" * 6]
    baseline = ["| noise | ours, mm | OpenCV, mm | factor |", "|---|---:|---:|---:|"]
    for noise_std in options.noise:
        outcomes = sessions(pool, options, noise_std)
        errors.append(quality(f"{1000 * noise_std:g} mm", outcomes))
        limits += limits_table(noise_std, outcomes)
        baseline.append(baseline_row(noise_std, outcomes))
        print(errors[-1], *limits[-5:], baseline[-1], sep="\n", flush=True)
    return "\n".join([*errors, "", *limits, "", *baseline])


if __name__ == "__main__":
    main()
