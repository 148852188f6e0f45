"""What detection comes to: primitives with scores and uncertainty, and candidates that were rejected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prim.shapes import Kind, Primitive


@dataclass(frozen=True)
class Detection:
    """A primitive with its ``score`` (0 to 1), YOLO's ``box`` (m: x0, y0, x1, y1), and the ``crop`` (pixels, pixels)
    that its parameters were read from.

    Where it was refined by rays (detect.refinement), ``std`` (m, rad) tells by name how sure its parameters are, and
    ``chances`` of what kind it is: the score is then its kind's, the box its outline's, and the crop is empty where
    the networks had not found it.
    """

    primitive: Primitive
    score: float
    box: tuple[float, float, float, float]
    crop: NDArray[np.uint8]
    std: Mapping[str, float] | None = None
    chances: Mapping[Kind, float] | None = None


@dataclass(frozen=True)
class Rejection:
    """A candidate that is no detection: kind, score, where its box has its middle (m), and by which threshold.

    ``fitted``: what the rays make of it, where they make anything of it.
    """

    kind: Kind
    score: float
    x: float
    y: float
    reason: str
    fitted: Detection | None = None


@dataclass(frozen=True)
class Detections:
    """What was found in a map, best first, and what was not taken for a primitive.

    ``doubtful``: of what was rejected, what scored too little and nothing else: the rays may speak for it.
    """

    found: tuple[Detection, ...]
    rejected: tuple[Rejection, ...]
    doubtful: tuple[tuple[Detection, Rejection], ...] = ()
