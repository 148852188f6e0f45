"""Evaluation on recorded sessions, as a replay processes them: mapped, detected, refined by the log's rays.

Average precision is computed in two ways. By the field's definition (COCO, PASCAL VOC) the boxes of what is reported
count, each with its kind and score. The other counts all candidates: of the networks those of every kind with their
scores, below the thresholds too, by the protocol of YOLOv5's validation; of refinement, by a rule of our own, every
primitive fitted to rays as each kind with that kind's posterior probability, and with a share of it where it was
rejected in the end.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from detect.detection import Detection, Detections
from detect.detector import Detector
from detect.evaluation.box_metrics import score_boxes
from detect.evaluation.evaluate import (
    PrimitivePair,
    matched_pairs,
    parameter_errors,
    precision_recall_f1,
    scored_candidates,
)
from detect.networks.tiles import tile_frames, tile_image
from detect.networks.yolo import KINDS, Boxes
from detect.refinement.options import DEFAULTS as REFINEMENT
from detect.refinement.refine import refine_detections
from detect.training.dataset import (
    DatasetOptions,
    Sample,
    map_frame,
    map_scans,
    primitives_in_tile,
    session_options,
    simulate_session,
)
from detect.training.matches import LabelledImage, ScoredBoxes
from prim.arrays import FloatArray
from prim.processes import process_pool
from prim.shapes import Kind, Primitive

MIN_PROBABILITY = 0.001
"""Smallest probability that a kind counts with: the score floor of YOLOv5's validation."""

REJECTED_WEIGHT = 0.1
"""Weight of the probabilities of primitives that were fitted and rejected: they seldom are there. Set by hand."""

CELLS_PER_METRE = 100
"""Boxes of primitives are given in cells of 10 mm."""


@dataclass(frozen=True)
class SessionScore:
    """Detections of a session compared with its ground truth.

    Attributes:
        scored: All candidates and true boxes, for each image.
        reported: The boxes of the detections, and true boxes.
        pairs: Detections that count as found, each with its true primitive.
        detections: Number of all detections.
        truths: Number of all true primitives.
    """

    scored: tuple[ScoredBoxes, ...]
    reported: ScoredBoxes
    pairs: tuple[PrimitivePair, ...]
    detections: int
    truths: int

    @classmethod
    def compare(
        cls, scored: Iterable[ScoredBoxes], detections: Sequence[Detection], truth: Sequence[Primitive]
    ) -> SessionScore:
        """Compare detections with the ground truth.

        Args:
            scored: All candidates and true boxes.
            detections: Detections.
            truth: True primitives.

        Returns:
            The comparison.
        """
        found = [detection.primitive for detection in detections]
        reported = reported_primitives(detections, truth)
        return cls(tuple(scored), reported, tuple(matched_pairs(found, truth)), len(found), len(truth))


def evaluate_session(
    seed: int, options: DatasetOptions, mapper: str, weights: Path, closed_world: bool = False
) -> tuple[SessionScore, SessionScore]:
    """Record a session, map it, detect and refine.

    Args:
        seed: Seed of the session.
        options: How it is recorded.
        mapper: Name of the mapper.
        weights: Folder of the detector's weights.
        closed_world: Whether refinement takes all that stands there to be one of the kinds, or a wall.

    Returns:
        The score of the networks alone, and that after refinement; objects of no kind count in neither.
    """
    world, scans = simulate_session(session_options(options, seed))
    frame = map_frame(world, options.resolution)
    grid = map_scans(mapper, scans, options.resolution, frame.bounds, threads=1)
    detector = _load_detector(weights, mapper)
    detections = detector.detect(grid)
    refinement = replace(REFINEMENT, closed_world=closed_world)
    refined, _ = refine_detections(detections, scans, grid, None, 1, options=refinement)
    images = [
        LabelledImage(
            Sample(Path(), tile, primitives_in_tile(world.primitives, tile), 0.0),
            tile_image(grid, tile, detector.card.style),
        )
        for tile in tile_frames(frame)
    ]
    candidates = scored_candidates(detector.yolo, images)
    return (
        SessionScore.compare(candidates, detections.found, world.primitives),
        SessionScore.compare([scored_primitives(refined, world.primitives)], refined.found, world.primitives),
    )


def evaluate_sessions(
    seeds: Sequence[int],
    options: DatasetOptions,
    mapper: str,
    weights: Path,
    jobs: int | None = None,
    closed_world: bool = False,
) -> dict[str, Any]:
    """Evaluate sessions in processes of one thread each; their number does not change the results.

    Args:
        seeds: Seeds of the sessions.
        options: How they are recorded.
        mapper: Name of the mapper.
        weights: Folder of the detector's weights.
        jobs: Number of processes; None: one for each available core.
        closed_world: As for :func:`evaluate_session`.

    Returns:
        Results as they are stored: ``networks`` (alone) and ``refined``, each as :func:`summarize_sessions`.
    """
    evaluate = partial(evaluate_session, options=options, mapper=mapper, weights=weights, closed_world=closed_world)
    with process_pool(jobs) as pool:
        scores = list(pool.map(evaluate, seeds))
    networks, refined = zip(*scores, strict=True)
    return {"networks": summarize_sessions(networks), "refined": summarize_sessions(refined)}


def summarize_sessions(scores: Sequence[SessionScore]) -> dict[str, Any]:
    """Compute metrics over sessions.

    Args:
        scores: The sessions' scores.

    Returns:
        ``boxes`` (BoxMetrics of all candidates), ``reported`` (BoxMetrics of the detections) and ``errors``
        (ParameterErrors), each by kind and for ``all``; ``found``: precision, recall and F1 of the detections.
    """
    pairs = [pair for score in scores for pair in score.pairs]
    metrics = score_boxes([scored for score in scores for scored in score.scored])
    reported = score_boxes([score.reported for score in scores])
    detections, truths = sum(score.detections for score in scores), sum(score.truths for score in scores)
    return {
        "boxes": {name: asdict(row) for name, row in metrics.items()},
        "reported": {name: asdict(row) for name, row in reported.items()},
        "errors": {name: asdict(row) for name, row in parameter_errors(pairs).items()},
        "found": precision_recall_f1(len(pairs), detections, truths),
    }


@lru_cache(maxsize=4)
def _load_detector(weights: Path, mapper: str) -> Detector:
    return Detector.load(weights, mapper, 1)


def reported_primitives(detections: Sequence[Detection], truth: Sequence[Primitive]) -> ScoredBoxes:
    """Return the boxes around the outlines of detections, each with its kind and its score.

    Args:
        detections: Detections.
        truth: True primitives.

    Returns:
        The boxes and true boxes, in cells of 10 mm.
    """
    candidates = [(detection.primitive, detection.primitive.kind, detection.score) for detection in detections]
    return _scored_boxes(candidates, truth)


def scored_primitives(refined: Detections, truth: Sequence[Primitive]) -> ScoredBoxes:
    """Return boxes around refined outlines as candidates of each kind, scored by that kind's posterior probability.

    Args:
        refined: Refined detections, and rejected candidates with what was fitted to them.
        truth: True primitives.

    Returns:
        Candidates and true boxes, in cells of 10 mm.
    """
    rejected = [rejection.fitted for rejection in refined.rejected if rejection.fitted is not None]
    candidates = [
        (detection.primitive, kind, weight * probability)
        for detections, weight in ((refined.found, 1.0), (rejected, REJECTED_WEIGHT))
        for detection in detections
        for kind, probability in _kind_probabilities(detection).items()
        if weight * probability >= MIN_PROBABILITY
    ]
    return _scored_boxes(candidates, truth)


def _scored_boxes(candidates: Sequence[tuple[Primitive, Kind, float]], truth: Sequence[Primitive]) -> ScoredBoxes:
    """Return the boxes of candidates (each with the kind that it counts as, and a score) and of true primitives."""
    boxes = np.array([primitive_box(primitive) for primitive, _, _ in candidates], np.float32).reshape(-1, 4)
    kinds = np.array([KINDS.index(kind) for _, kind, _ in candidates], np.intp)
    scores = np.array([score for _, _, score in candidates], np.float32)
    true_box = np.array([primitive_box(primitive) for primitive in truth], np.float32).reshape(-1, 4)
    true_kind = np.array([KINDS.index(primitive.kind) for primitive in truth], np.intp)
    return ScoredBoxes(Boxes(boxes, kinds, scores), true_box, true_kind)


def _kind_probabilities(detection: Detection) -> dict[Kind, float]:
    """Return a detection's kinds with their probabilities; its own with its score where it was not refined."""
    return dict(detection.kind_probabilities or {detection.primitive.kind: detection.score})


def primitive_box(primitive: Primitive) -> FloatArray:
    """Return the bounding box (4,) of an outline: x0, y0, x1, y1 in cells of 10 mm."""
    outline = CELLS_PER_METRE * primitive.outline()
    return np.concatenate((outline.min(axis=0), outline.max(axis=0)))
