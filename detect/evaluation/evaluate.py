"""How good a detector is on a set: the paper's Tables I and II, and what its abstract claims."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from detect.detection import Detection
from detect.detector import FLOOR as CANDIDATE
from detect.detector import OVERLAP_LIMIT, Detector
from detect.evaluation.box_metrics import Marked, Scores, best_confidences, score_boxes
from detect.networks.cnn import Found
from detect.networks.yolo import KINDS, Boxes, Yolo, overlap, suppress
from detect.training.dataset import Sample, box_of, read_image
from prim.metrics import match_primitives
from prim.shapes import Kind, Primitive, angle_error

FLOOR = 0.001
"""Candidates of less are not looked at: as in YOLOv5's own evaluation."""

SUPPRESSION = 0.6
"""The IoU beyond which the worse of two candidates of a kind goes: as in YOLOv5's own evaluation."""

MOST = 300
"""No more candidates an image than this: as in YOLOv5's own evaluation."""

BATCH = 8

CLEARLY_UNLIKE = 0.1
"""Sides that differ by this share of the longest: the shape looks another when it is turned."""

Result = TypeVar("Result")
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Errors:
    """A row of Table II: mean absolute errors (rad, m) over ``count`` primitives; angles modulo the symmetry.

    Width and height of ``all`` leave out circles, as the paper's do (its means show it). ``median_angle``: the median
    of the angle's errors; ``clear_angle``: their mean over shapes whose sides differ by a tenth or more, all others
    look nearly the same when they are turned; ``size``: the mean error of the sizes as a share of the true ones.
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
    """What a detector does on a set: rows for ``all`` and for each kind that occurs.

    ``boxes``: Table I; ``true_boxes``: Table II, parameters read at true boxes; ``detected``: the same for what the
    whole pipeline finds (kind right, polygons' IoU 0.5); ``found``: of the pipeline, precision, recall and F1 by
    that rule; ``kind_accuracy``: of true primitives that a detection's box covers (IoU 0.5), the share whose kind is
    right; times (s) are means of one image, one after the other.
    """

    images: int
    boxes: dict[str, Scores]
    true_boxes: dict[str, Errors]
    detected: dict[str, Errors]
    found: tuple[float, float, float]
    kind_accuracy: float | None
    yolo_time: float
    parameters_time: float
    whole_time: float

    def to_json(self) -> dict[str, Any]:
        """As it is kept."""
        return asdict(self)


@dataclass(frozen=True)
class Pictured:
    """A sample with its image."""

    sample: Sample
    image: NDArray[np.uint8]

    @property
    def true_boxes(self) -> list[Found]:
        """Its primitives as the estimator takes them."""
        grey = np.ascontiguousarray(self.image[..., 0])
        frame = self.sample.frame
        return [Found(grey, frame, box_of(one, frame), one.kind) for one in self.sample.primitives]

    def marked(self, boxes: Boxes) -> Marked:
        """Candidates beside the true boxes."""
        true = [box_of(primitive, self.sample.frame) for primitive in self.sample.primitives]
        kinds = [KINDS.index(primitive.kind) for primitive in self.sample.primitives]
        return Marked(boxes, np.array(true, np.float32).reshape(-1, 4), np.array(kinds, dtype=np.intp))


def evaluate(detector: Detector, samples: Sequence[Sample], progress: Progress | None = None) -> Evaluation:
    """Runs a detector over a set's samples."""
    marked: list[Marked] = []
    at_truth: list[tuple[Primitive, Primitive]] = []
    detected: list[tuple[Primitive, Primitive]] = []
    detections = right = covered = 0
    times = np.zeros(3)
    for done, sample in enumerate(samples, start=1):
        pictured = Pictured(sample, read_image(sample))
        _, yolo_time = _timed(partial(detector.yolo, pictured.image[None], FLOOR))
        read, parameters_time = _timed(partial(detector.estimator, pictured.true_boxes))
        tile = [(sample.frame, pictured.image)]
        whole, whole_time = _timed(partial(detector.detect_images, tile, sample.frame))
        times += yolo_time, parameters_time, whole_time
        marked += mark(detector.yolo, [pictured])
        at_truth += zip(read, sample.primitives, strict=True)
        found = [one.primitive for one in whole.found]
        detections += len(found)
        pairs = match_primitives(found, sample.primitives)
        detected += [(found[pair.detection], sample.primitives[pair.truth]) for pair in pairs if pair.found]
        kinds = _kinds_on_truth(whole.found, sample)
        right, covered = right + sum(kinds), covered + len(kinds)
        if progress:
            progress(done, len(samples))
    truths = sum(len(sample.primitives) for sample in samples)
    mean = times / max(len(samples), 1)
    return Evaluation(
        images=len(samples),
        boxes=score_boxes(marked),
        true_boxes=errors_of(at_truth),
        detected=errors_of(detected),
        found=found_rates(len(detected), detections, truths),
        kind_accuracy=right / covered if covered else None,
        yolo_time=float(mean[0]),
        parameters_time=float(mean[1]),
        whole_time=float(mean[2]),
    )


def choose_thresholds(yolo: Yolo, samples: Sequence[Sample]) -> dict[str, float]:
    """For each kind the least score that makes its F1 largest on a set's samples, among a detector's candidates."""
    marked: list[Marked] = []
    for begin in range(0, len(samples), BATCH):
        batch = [Pictured(sample, read_image(sample)) for sample in samples[begin : begin + BATCH]]
        seen = yolo(np.stack([one.image for one in batch]), CANDIDATE)
        for one, boxes in zip(batch, seen, strict=True):
            stay = suppress(boxes, OVERLAP_LIMIT) == np.arange(len(boxes))
            marked.append(one.marked(boxes[stay]))
    return best_confidences(marked)


def mark(yolo: Yolo, batch: Sequence[Pictured]) -> list[Marked]:
    """Candidates beside true boxes, by the rules of YOLOv5's own evaluation."""
    images = np.stack([one.image for one in batch])
    return [
        one.marked(thinned(boxes)) for one, boxes in zip(batch, yolo(images, FLOOR, every_kind=True), strict=True)
    ]


def thinned(boxes: Boxes) -> Boxes:
    """The MOST best candidates that no better one of their kind suppresses."""
    stay = np.flatnonzero(suppress(boxes, SUPPRESSION, per_kind=True) == np.arange(len(boxes)))
    best = stay[np.argsort(-boxes.score[stay], kind="stable")]
    return boxes[best[:MOST]]


def _timed(call: Callable[[], Result]) -> tuple[Result, float]:
    """What a call gives, and how long it takes (s)."""
    began = time.perf_counter()
    return call(), time.perf_counter() - began


def _kinds_on_truth(found: Sequence[Detection], sample: Sample) -> list[bool]:
    """For each true primitive that a detection's box covers: whether the kind of the best such detection is right."""
    boxes = np.array([one.box for one in found], np.float32).reshape(-1, 4)
    right = []
    for primitive in sample.primitives:
        outline = primitive.outline()
        true = np.concatenate((outline.min(axis=0), outline.max(axis=0))).astype(np.float32)
        shared = overlap(true, boxes)
        if len(found) and shared.max() >= 0.5:
            right.append(found[int(shared.argmax())].primitive.kind is primitive.kind)
    return right


def found_rates(hits: int, detections: int, truths: int) -> tuple[float, float, float]:
    """Precision, recall, F1."""
    return hits / max(detections, 1), hits / max(truths, 1), 2 * hits / max(detections + truths, 1)


def errors_of(pairs: Sequence[tuple[Primitive, Primitive]]) -> dict[str, Errors]:
    """Errors of pairs of an estimate and a truth of one kind: for ``all``, and for each kind."""
    if not pairs:
        return {}
    rows = {kind.value: [pair for pair in pairs if pair[1].kind is kind] for kind in Kind}
    angular = [pair for pair in pairs if pair[1].kind.has_angle]
    each = {name: _mean_errors(own, own) for name, own in rows.items() if own}
    return {"all": _mean_errors(pairs, angular)} | each


def _mean_errors(
    pairs: Sequence[tuple[Primitive, Primitive]], measured: Sequence[tuple[Primitive, Primitive]]
) -> Errors:
    """Means over ``pairs``; widths and heights over ``measured``."""
    angles = [(error, pair[1]) for pair in pairs if (error := angle_error(*pair)) is not None]
    both = [(one.width_height, true.width_height) for one, true in measured]
    sizes = [(one.width_height, true.width_height) for one, true in pairs]
    return Errors(
        count=len(pairs),
        angle=_mean(error for error, _ in angles),
        median_angle=float(np.median([error for error, _ in angles])) if angles else None,
        clear_angle=_mean(error for error, true in angles if _is_clear(true)),
        width=_mean(abs(one[0] - true[0]) for one, true in both),
        height=_mean(abs(one[1] - true[1]) for one, true in both),
        size=float(np.mean([abs(one[k] - true[k]) / true[k] for one, true in sizes for k in (0, 1)])),
        position=float(np.mean([math.hypot(one.x - true.x, one.y - true.y) for one, true in pairs])),
    )


def _is_clear(primitive: Primitive) -> bool:
    """Whether a shape looks another when it is turned within its kind's symmetry: its sides differ by a tenth."""
    row = primitive.kind.row
    return row.period == row.regular_period or not primitive.sides_agree(CLEARLY_UNLIKE)


def _mean(values: Iterable[float]) -> float | None:
    """None of nothing."""
    listed = list(values)
    return float(np.mean(listed)) if listed else None
