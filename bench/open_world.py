"""Evaluation in an open world: clutter, rooms, contacts, scanners with faults; how reliable detections are.

    python -m bench.open_world [--sessions 40] [--rows clutter …] [--update docs/open_world.md]

Sessions on which nothing was trained or chosen (seeds from 90000), recorded as ``prim-record`` does with the options
that a row names, mapped by the forward mapper, detected by the shipped networks, refined. A thing that is none of
the kinds counts where no primitive covers it with more than 0.90 (IoU; recorder.clutter.cover). It is reported as a
kind where a detection with a score above 0.5 overlaps it more than any true primitive.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from bench.maps import update
from bench.refine import parameter_errors
from bench.sessions import scans_with_poses
from detect.detection import Detection
from detect.detector import Detector
from detect.networks.weights import SHIPPED
from detect.refinement.options import DEFAULTS
from detect.refinement.refine import refine_detections
from mapping.mapper import make_mapper
from prim.log import open_log
from prim.metrics import match_primitives, outline_iou
from prim.world import World
from recorder.clutter import cover
from recorder.faults import ScannerFaults
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from recorder.world import WorldOptions
from replay.ground_truth import GroundTruth
from replay.mapping.bounds import grid_frame_of_world

FIRST_SEED = 90_000

FEW = WorldOptions(per_kind=(0, 1))
EMPTY = WorldOptions(per_kind=(0, 0))

ROWS: Mapping[str, WorldOptions] = {
    "the paper's worlds": WorldOptions(),
    "few primitives": FEW,
    "six things among them": replace(FEW, clutter=(6, 6)),
    "empty: doorways": replace(EMPTY, room=("doorways",)),
    "empty: pilasters": replace(EMPTY, room=("pilasters",)),
    "empty: round": replace(EMPTY, room=("round",)),
    "doorways": replace(FEW, room=("doorways",)),
    "furniture": replace(FEW, room=("furniture",)),
    "3 cm from walls": replace(FEW, at_walls=0.03),
    "touching walls": replace(FEW, at_walls=0.0),
    "touching pairs": replace(FEW, per_kind=(1, 1), touching=True),
}
"""The worlds, by the names of rows."""

FAULTS: Mapping[str, ScannerFaults] = {
    "dropouts of 10 % as inf": ScannerFaults(dropouts=0.1),
    "range bias of 20 mm": ScannerFaults(range_bias=0.02),
    "beams of 1 degree": ScannerFaults(beam_width=math.radians(1)),
}
"""Scanners, by the names of rows; each in the paper's worlds."""

LEVELS = {"six things among them": (0.02, 0.05, 0.25), "the paper's worlds": (0.05, 0.25)}
"""Noise (m) of rows that have other levels than these:"""
USUAL_LEVELS = (0.02, 0.05)

COVERED = 0.90
"""IoU from which on a thing counts as the primitive that covers it."""
COVERS = (0.80, 0.85, 0.90, 0.95, 1.0)
REPORTED_SCORE = 0.5
SCORES = (0.0, 0.5, 0.7, 0.9, 0.97, 1.0)


@dataclass(frozen=True)
class Reported:
    """A detection: its score, whether it is right, and the thing of no kind that it covers most, by index."""

    score: float
    is_right: bool
    thing: int | None


@dataclass(frozen=True)
class Outcome:
    """The evaluation of one session.

    Attributes:
        reported: The detections.
        truths: Number of true primitives.
        covers: For each thing of no kind the IoU of a primitive that covers it best.
        sizes: Absolute errors of sizes (m) of right ones, by the index of the true primitive.
        z: Errors of right ones over their standard deviations.
        candidates: Number of detections, objects and fitted rejections.
        refine_s: CPU time of refinement (s).
    """

    reported: tuple[Reported, ...]
    truths: int
    covers: tuple[float, ...]
    sizes: tuple[float, ...]
    z: tuple[float, ...]
    candidates: int
    refine_s: float


def session_options(name: str, noise_std: float, seed: int) -> SessionOptions:
    """Return what a row's session is recorded with.

    Args:
        name: The row.
        noise_std: Standard deviation of the range noise (m).
        seed: The session's.

    Returns:
        The options.
    """
    lidar = Lidar(noise_std=noise_std, faults=FAULTS.get(name, ScannerFaults()))
    return SessionOptions(seed=seed, world=ROWS.get(name, WorldOptions()), lidar=lidar)


def outcome(seed: int, name: str, noise_std: float, closed_world: bool) -> Outcome:
    """Record a session, map it, detect, refine, and compare with the world.

    Args:
        seed: The session's.
        name: The row.
        noise_std: Standard deviation of the range noise (m).
        closed_world: Whether nothing is held against «none of the kinds».

    Returns:
        The evaluation.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.mcap"
        record_session(path, session_options(name, noise_std, seed))
        with open_log(path) as log:
            truth = GroundTruth.read(log)
            assert truth is not None
            scans = scans_with_poses(log, "truth")
    frame = grid_frame_of_world(truth.world, 0.01)
    mapper = make_mapper("forward", 0.01, frame.bounds)
    for scan, pose in scans:
        mapper.accumulate(scan, pose)
    grid = mapper.finish()
    detections = Detector.load(SHIPPED / "forward", "forward", 1).detect(grid)
    began = time.process_time()
    options = replace(DEFAULTS, closed_world=closed_world)
    refined, _ = refine_detections(detections, scans, grid, None, 1, options=options)
    taken = time.process_time() - began
    fitted = len(refined.found) + len(refined.objects) + sum(one.fitted is not None for one in refined.rejected)
    return compare(refined.found, truth.world, fitted, taken)


def compare(found: Sequence[Detection], world: World, candidates: int, refine_s: float) -> Outcome:
    """Compare detections with a world.

    Args:
        found: The detections.
        world: The world.
        candidates: Number of candidates that were fitted.
        refine_s: CPU time of refinement (s).

    Returns:
        The evaluation.
    """
    primitives = [detection.primitive for detection in found]
    pairs = {pair.detection: pair for pair in match_primitives(primitives, world.primitives)}
    things = [np.array(solid.outline) for solid in world.clutter]
    reported, sizes, z = [], [], []
    for k, detection in enumerate(found):
        pair = pairs.get(k)
        is_right = pair is not None and pair.found
        outline = detection.primitive.outline()
        shared = [outline_iou(outline, thing) for thing in things]
        of_truth = max((outline_iou(outline, true.outline()) for true in world.primitives), default=0.0)
        best = int(np.argmax(shared)) if shared and max(shared) > max(of_truth, 0.1) else None
        reported.append(Reported(detection.score, is_right, best))
        if is_right and pair is not None:
            true, kind = world.primitives[pair.truth], detection.primitive.kind
            errors = parameter_errors(detection.primitive, true)
            stds = detection.std or {}
            z += [error / stds[name] for error, name in zip(errors, kind.parameters, strict=True)]
            sizes += [abs(error) for error in errors[-len(kind.sizes) :]]
    covers = tuple(cover(thing) for thing in things)
    return Outcome(tuple(reported), len(world.primitives), covers, tuple(sizes), tuple(z), candidates, refine_s)


def things_reported(outcomes: Sequence[Outcome], covered: float = COVERED) -> tuple[int, int]:
    """Count things of no kind that no primitive covers better than ``covered``.

    Args:
        outcomes: The sessions.
        covered: IoU.

    Returns:
        How many are reported as a kind, and how many there are.
    """
    reported = there = 0
    for one in outcomes:
        counting = {k for k, share in enumerate(one.covers) if share <= covered}
        there += len(counting)
        reported += len(counting & {each.thing for each in one.reported if each.score > REPORTED_SCORE})
    return reported, there


def row(name: str, noise_std: float, outcomes: Sequence[Outcome]) -> str:
    """Return a row of the table.

    Args:
        name: Its name.
        noise_std: Standard deviation of the range noise (m).
        outcomes: The sessions.

    Returns:
        The row.
    """
    reported = [one for session in outcomes for one in session.reported]
    right, truths = sum(one.is_right for one in reported), sum(session.truths for session in outcomes)
    others, there = things_reported(outcomes)
    false = sum(not one.is_right and one.score > REPORTED_SCORE and one.thing is None for one in reported) / len(
        outcomes
    )
    sure = [one.is_right for one in reported if one.score >= 0.9]
    z = np.array([value for session in outcomes for value in session.z])
    sizes = 1000 * np.array([value for session in outcomes for value in session.sizes])
    candidates = sum(session.candidates for session in outcomes)
    cells = (
        f"{name}, {1000 * noise_std:g} mm",
        f"{2 * right / (len(reported) + truths):.3f}" if truths else "–",
        f"{others / there:.1%} of {there}" if there else "–",
        f"{false:.2f}",
        f"{np.mean(sure):.3f} of {len(sure)}" if sure else "–",
        f"{sizes.mean():.2f} / {np.median(sizes):.2f}" if len(sizes) else "–",
        f"{np.sqrt(np.mean(z**2)):.2f}" if len(z) else "–",
        f"{np.mean(np.abs(z) < 1.96):.1%}" if len(z) else "–",
        f"{1000 * sum(session.refine_s for session in outcomes) / max(candidates, 1):.0f}",
    )
    return f"| {' | '.join(cells)} |"


HEAD = [
    "| worlds, noise | F1 | things reported as a kind | other false ones a session | right of those reported ≥ 0.9 | "
    "size, mm: mean / median | z, RMS | 95 % bars hold | CPU ms |",
    "|---|" + "---:|" * 8,
]


def curves(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the reliability of scores, and the share of things reported as a kind over their cover by a primitive.

    Args:
        outcomes: All sessions.

    Returns:
        Lines of two tables.
    """
    reported = [one for session in outcomes for one in session.reported]
    lines = ["", "| score | right | of |", "|---|---:|---:|"]
    for low, high in pairwise(SCORES):
        within = [one.is_right for one in reported if low <= one.score < high or (high == 1.0 and one.score == 1.0)]
        lines.append(
            f"| {low:g} to {high:g} | {np.mean(within):.3f} | {len(within)} |"
            if within
            else f"| {low:g} to {high:g} | – | 0 |"
        )
    lines += ["", "| covered by a primitive (IoU) up to | reported as a kind | of |", "|---|---:|---:|"]
    for covered in COVERS:
        others, there = things_reported(outcomes, covered)
        lines.append(f"| {covered:g} | {others / max(there, 1):.1%} | {there} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sessions", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--rows", nargs="+", choices=[*ROWS, *FAULTS], default=[*ROWS, *FAULTS])
    parser.add_argument("--noise", type=float, nargs="+", help="levels (m) in the place of the rows' own")
    parser.add_argument("--closed-world", action="store_true")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--update", type=Path, help="the document that gets the tables")
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.sessions)
    lines, mixed = [*HEAD], []
    with ProcessPoolExecutor(options.workers) as pool:
        for name in options.rows:
            for noise_std in options.noise or LEVELS.get(name, USUAL_LEVELS):
                evaluate: Callable[[int], Outcome] = partial(
                    outcome, name=name, noise_std=noise_std, closed_world=options.closed_world
                )
                outcomes = list(pool.map(evaluate, seeds))
                mixed += outcomes if noise_std in USUAL_LEVELS else []
                lines.append(row(name, noise_std, outcomes))
                print(lines[-1], flush=True)
    lines += curves(mixed)
    print(*curves(mixed), sep="\n")
    if options.update:
        update(options.update, "open world", "\n".join(lines))


if __name__ == "__main__":
    main()
