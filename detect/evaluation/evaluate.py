"""Evaluation of a detector on a data set: the paper's Tables I and II, and the claims of its abstract."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from detect.detection import Detection
from detect.detector import Detector
from detect.evaluation.box_metrics import BoxMetrics, score_boxes
from detect.networks.yolo import Boxes, Yolo, box_iou, non_maximum_suppression
from detect.training.dataset import Progress, Sample, read_image
from detect.training.matches import LabelledImage, ScoredBoxes
from prim.metrics import match_primitives
from prim.shapes import Kind, Primitive, angle_error

Result = TypeVar("Result")
PrimitivePair = tuple[Primitive, Primitive]
"""An estimate and the true primitive, of one kind."""


@dataclass(frozen=True)
class EvaluationOptions:
    """Protocol of the evaluation of boxes and parameters."""

    score_floor: float = 0.001
    """Smallest score of a candidate: YOLOv5's validation."""

    nms_iou: float = 0.6
    """Largest intersection over union of two candidates of a kind: YOLOv5's validation."""

    max_candidates: int = 300
    """Largest number of candidates in an image: YOLOv5's validation."""

    distinct_sides: float = 0.1
    """Difference of a shape's sides, as a share of the longest, from which its angle is well defined; set by hand."""

    kind_iou: float = 0.5
    """Smallest intersection over union of a true box and the detection that its kind is compared with."""


DEFAULTS = EvaluationOptions()


@dataclass(frozen=True)
class ParameterErrors:
    """A row of Table II: mean absolute errors; the fields are the keys of results.

    Attributes:
        count: Number of primitives.
        angle: Angle (rad), modulo the symmetry; None where no kind has one.
        median_angle: Median instead of mean.
        clear_angle: Mean over shapes whose sides differ by EvaluationOptions.distinct_sides or more.
        width: Width (m); of ``all`` without circles, as the paper's means.
        height: Height (m), likewise.
        size: Sizes, as a share of the true ones.
        position: Centroid (m).
    """

    count: int
    angle: float | None
    median_angle: float | None
    clear_angle: float | None
    width: float | None
    height: float | None
    size: float
    position: float


@dataclass(frozen=True)
class Evaluation:
    """Results of a detector on a data set, for ``all`` and for each kind that occurs; the fields are keys of results.

    Attributes:
        images: Number of images.
        boxes: Table I.
        true_boxes: Table II, parameters estimated at true boxes.
        detected: The same for what the whole pipeline detects (kind right, polygon IoU at least 0.5).
        found: Precision, recall and F1 of the whole pipeline by that rule.
        kind_accuracy: Share of true primitives covered by a detection's box (IoU at least 0.5) with the right kind;
            None where none is covered.
        yolo_time: Mean time (s) of YOLO for one image; images are processed one after the other.
        parameters_time: The same of the parameter networks.
        whole_time: The same of the whole pipeline.
    """

    images: int
    boxes: dict[str, BoxMetrics]
    true_boxes: dict[str, ParameterErrors]
    detected: dict[str, ParameterErrors]
    found: tuple[float, float, float]
    kind_accuracy: float | None
    yolo_time: float
    parameters_time: float
    whole_time: float

    def to_json(self) -> dict[str, Any]:
        """Return the values as they are stored."""
        return asdict(self)


def evaluate_detector(detector: Detector, samples: Sequence[Sample], progress: Progress | None = None) -> Evaluation:
    """Evaluate a detector on the tiles of a data set.

    Args:
        detector: The detector.
        samples: The tiles.
        progress: Called after each tile.

    Returns:
        The results.
    """
    scored: list[ScoredBoxes] = []
    at_true_boxes: list[PrimitivePair] = []
    detected: list[PrimitivePair] = []
    kinds_right: list[bool] = []
    detections = 0
    times = np.zeros(3)
    for done, sample in enumerate(samples, start=1):
        labelled = LabelledImage(sample, read_image(sample))
        _, yolo_time = _timed(partial(detector.yolo, labelled.image[None], DEFAULTS.score_floor))
        estimates, parameters_time = _timed(partial(detector.estimator, labelled.true_boxes))
        tile = [(sample.frame, labelled.image)]
        whole, whole_time = _timed(partial(detector.detect_tiles, tile, sample.frame))
        times += yolo_time, parameters_time, whole_time
        scored += scored_candidates(detector.yolo, [labelled])
        estimated = zip(estimates, sample.primitives, strict=True)
        at_true_boxes += [(found, truth) for found, truth in estimated if found is not None]
        primitives = [detection.primitive for detection in whole.found]
        detections += len(primitives)
        detected += matched_pairs(primitives, sample.primitives)
        kinds_right += _kinds_at_true_boxes(whole.found, sample)
        if progress:
            progress(done, len(samples))
    mean = times / max(len(samples), 1)
    return Evaluation(
        images=len(samples),
        boxes=score_boxes(scored),
        true_boxes=parameter_errors(at_true_boxes),
        detected=parameter_errors(detected),
        found=precision_recall_f1(len(detected), detections, sum(len(sample.primitives) for sample in samples)),
        kind_accuracy=sum(kinds_right) / len(kinds_right) if kinds_right else None,
        yolo_time=float(mean[0]),
        parameters_time=float(mean[1]),
        whole_time=float(mean[2]),
    )


def scored_candidates(
    yolo: Yolo, images: Sequence[LabelledImage], options: EvaluationOptions = DEFAULTS
) -> list[ScoredBoxes]:
    """Run YOLO on labelled images by the protocol of YOLOv5's validation.

    Args:
        yolo: The network.
        images: The images, one batch.
        options: The protocol.

    Returns:
        Candidates and true boxes of each image.
    """
    stacked = np.stack([labelled.image for labelled in images])
    candidates = yolo(stacked, options.score_floor, multi_label=True)
    return [
        labelled.with_candidates(best_candidates(boxes, options))
        for labelled, boxes in zip(images, candidates, strict=True)
    ]


def best_candidates(boxes: Boxes, options: EvaluationOptions = DEFAULTS) -> Boxes:
    """Apply non-maximum suppression by kind and keep the best candidates.

    Args:
        boxes: Candidates of one image.
        options: Largest overlap and largest number.

    Returns:
        The remaining candidates in descending order of score.
    """
    suppressor = non_maximum_suppression(boxes, options.nms_iou, per_kind=True)
    kept = np.flatnonzero(suppressor == np.arange(len(boxes)))
    best = kept[np.argsort(-boxes.score[kept], kind="stable")]
    return boxes[best[: options.max_candidates]]


def _timed(call: Callable[[], Result]) -> tuple[Result, float]:
    """Return the result of a call and its duration (s)."""
    began = time.perf_counter()
    return call(), time.perf_counter() - began


def _kinds_at_true_boxes(detections: Sequence[Detection], sample: Sample) -> list[bool]:
    """Return for each true primitive covered by a detection's box whether the kind of the best such one is right."""
    boxes = np.array([detection.box for detection in detections], np.float32).reshape(-1, 4)
    right = []
    for primitive in sample.primitives:
        outline = primitive.outline()
        true = np.concatenate((outline.min(axis=0), outline.max(axis=0))).astype(np.float32)
        iou = box_iou(true, boxes)
        if len(detections) and iou.max() >= DEFAULTS.kind_iou:
            right.append(detections[int(iou.argmax())].primitive.kind is primitive.kind)
    return right


def matched_pairs(found: Sequence[Primitive], truth: Sequence[Primitive]) -> list[PrimitivePair]:
    """Match detected to true primitives.

    Args:
        found: Detected primitives.
        truth: True primitives.

    Returns:
        The pairs that count as found: kind right, polygon IoU at least 0.5.
    """
    pairs = match_primitives(found, truth)
    return [(found[pair.detection], truth[pair.truth]) for pair in pairs if pair.found]


def precision_recall_f1(hits: int, detections: int, truths: int) -> tuple[float, float, float]:
    """Compute precision, recall and F1.

    Args:
        hits: True positives.
        detections: All detections.
        truths: All true primitives.

    Returns:
        The three, 0 where there is nothing to divide by.
    """
    return hits / max(detections, 1), hits / max(truths, 1), 2 * hits / max(detections + truths, 1)


def parameter_errors(pairs: Sequence[PrimitivePair]) -> dict[str, ParameterErrors]:
    """Compute mean errors of matched pairs, for ``all`` and for each kind that occurs; none where there are none."""
    if not pairs:
        return {}
    rows = {kind.value: [pair for pair in pairs if pair[1].kind is kind] for kind in Kind}
    with_angle = [pair for pair in pairs if pair[1].kind.has_angle]
    by_kind = {name: _mean_errors(own, own) for name, own in rows.items() if own}
    return {"all": _mean_errors(pairs, with_angle)} | by_kind


def _mean_errors(pairs: Sequence[PrimitivePair], measured: Sequence[PrimitivePair]) -> ParameterErrors:
    """Compute means over ``pairs``; of widths and heights over ``measured``."""
    angles = [(error, pair[1]) for pair in pairs if (error := angle_error(*pair)) is not None]
    widths_heights = [(estimate.width_height, true.width_height) for estimate, true in measured]
    sizes = [(estimate.width_height, true.width_height) for estimate, true in pairs]
    return ParameterErrors(
        count=len(pairs),
        angle=_mean(error for error, _ in angles),
        median_angle=float(np.median([error for error, _ in angles])) if angles else None,
        clear_angle=_mean(error for error, true in angles if _has_clear_angle(true)),
        width=_mean(abs(estimate[0] - true[0]) for estimate, true in widths_heights),
        height=_mean(abs(estimate[1] - true[1]) for estimate, true in widths_heights),
        size=float(np.mean([abs(estimate[k] - true[k]) / true[k] for estimate, true in sizes for k in (0, 1)])),
        position=float(np.mean([math.hypot(estimate.x - true.x, estimate.y - true.y) for estimate, true in pairs])),
    )


def _has_clear_angle(primitive: Primitive) -> bool:
    """Return whether a shape is clearly not the more symmetric one that its kind becomes with equal sides."""
    row = primitive.kind.row
    return row.period == row.regular_period or not primitive.sides_agree(DEFAULTS.distinct_sides)


def _mean(values: Iterable[float]) -> float | None:
    """Return the mean; None where there are no values."""
    listed = list(values)
    return float(np.mean(listed)) if listed else None
