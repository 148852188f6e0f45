"""Results of detection: primitives with scores and uncertainties, and rejected candidates."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.arrays import FloatArray
from prim.shapes import Kind, Primitive
from prim.world import Bounds

Progress = Callable[[int, int], None]
"""Called with what is done and what there is in all."""


def no_progress(done: int, total: int) -> None:
    """Report nothing.

    Args:
        done: What is done.
        total: What there is in all.
    """


OTHER = "other"
"""What the hypothesis «none of the kinds» is called beside the kinds' names."""


@dataclass(frozen=True)
class Detection:
    """A detected primitive.

    Attributes:
        primitive: Kind and parameters, map frame.
        score: Confidence, 0 to 1: the class score of YOLO; after refinement the posterior probability of the kind.
        box: Bounding box (m), map frame: YOLO's; after refinement that of the outline.
        crop: Crop of the map's image (pixels, pixels) that the parameters were estimated from; (0, 0) where the
            networks had not detected the primitive.
        std: Standard deviations (m, rad) of the parameters by name; None where nothing was refined.
        kind_probabilities: Posterior probabilities of the kinds; None where nothing was refined.
        covariance: (K, K) of the parameters in the kind's order (m, rad); None where nothing was refined. ``std`` has
            the square roots of its diagonal.
        since: Stamp (ns) of the scan from which on it stands there, by which it is refined; None for all scans.
        other_probability: Posterior probability that it is none of the kinds: the kinds' and this sum to 1.
    """

    primitive: Primitive
    score: float
    box: Bounds
    crop: NDArray[np.uint8]
    std: Mapping[str, float] | None = None
    kind_probabilities: Mapping[Kind, float] | None = None
    covariance: FloatArray | None = None
    since: int | None = None
    other_probability: float = 0.0


@dataclass(frozen=True, eq=False)
class UnknownObject:
    """Something that is likeliest none of the kinds: a shape of its own, or a part of something larger.

    Attributes:
        outline: Vertices (N, 2) of a closed outline in m, map frame, counter-clockwise; not always convex.
        std: Standard deviation of the outline (m), across it: the root mean square over the part that rays met.
        score: Posterior probability that it is none of the kinds, 0 to 1.
        reason: Why, in words and numbers.
        kind_probabilities: Posterior probabilities of the kinds; with the score they sum to 1.
        since: As Detection.since.
    """

    outline: FloatArray
    std: float
    score: float
    reason: str
    kind_probabilities: Mapping[Kind, float]
    since: int | None = None


@dataclass(frozen=True)
class Rejection:
    """A candidate that was rejected.

    Attributes:
        kind: Kind of the candidate.
        score: Its class score, 0 to 1.
        x: Centre of its box (m), map frame.
        y: The same along y.
        reason: Which test it failed, in words and numbers.
        fitted: The primitive fitted to its rays; None where refinement fitted none.
    """

    kind: Kind
    score: float
    x: float
    y: float
    reason: str
    fitted: Detection | None = None


@dataclass(frozen=True)
class SensorErrors:
    """Errors that all beams of a scanner have in common, as refinement found and corrected them.

    Attributes:
        range_bias: Measured less true range (m); 0 where no bias is significant.
        range_bias_std: Its standard deviation (m); None where there is none.
        nearest_within: The full angle (rad) of a beam within which it reads the nearest surface; 0 where its width
            does not show.
        mixed_within: The same, within which two surfaces may give a range between both.
    """

    range_bias: float = 0.0
    range_bias_std: float | None = None
    nearest_within: float = 0.0
    mixed_within: float = 0.0


@dataclass(frozen=True)
class Detections:
    """Detections and rejected candidates of one map.

    Attributes:
        found: Detections in descending order of score.
        rejected: Rejected candidates in descending order of score.
        doubtful: Candidates that were rejected for their score alone, with their rejections (which are in
            ``rejected`` too): refinement decides about them.
        rivals: Candidates that overlap a better one, which was seen in cells of another size and differs, with their
            rejections (which are in ``rejected`` too): refinement decides between them.
        objects: What is likeliest none of the kinds, in descending order of score; refinement alone finds them.
        sensor: Errors of the scanner that refinement corrected; None where it found none.
    """

    found: tuple[Detection, ...]
    rejected: tuple[Rejection, ...]
    doubtful: tuple[tuple[Detection, Rejection], ...] = ()
    rivals: tuple[tuple[Detection, Rejection], ...] = ()
    objects: tuple[UnknownObject, ...] = ()
    sensor: SensorErrors | None = None
