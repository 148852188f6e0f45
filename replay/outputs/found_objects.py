"""The objects that a replay found to be none of the kinds, as reports, the viewer and the API give them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from detect.detection import OTHER
from prim.arrays import FloatArray
from replay.detection.stage import DetectionResult

if TYPE_CHECKING:
    from detect.detection import UnknownObject

OBJECT_COLOR = (185, 185, 185)
"""Objects are drawn in this grey: lighter than the true primitives, since their outlines lie on occupied cells."""


@dataclass(frozen=True, eq=False)
class FoundObject:
    """Something that is likeliest none of the kinds: a shape of its own, or a part of something larger.

    Attributes:
        id: Its number, which no primitive has; those of one result follow each other, highest score first.
        outline: Vertices (N, 2) in the map frame (m), counter-clockwise; not always convex.
        std: Standard deviation of the outline (m), across it.
        score: 0 to 1: the posterior probability that it is none of the kinds.
        reason: Why it is taken to be none.
        chances: The posterior probability of each kind by its name, and of ``other``, which is the score.
    """

    id: int
    outline: FloatArray
    std: float
    score: float
    reason: str
    chances: Mapping[str, float]

    @classmethod
    def of(cls, thing: UnknownObject, number: int) -> FoundObject:
        """Return what detection found under a number.

        Args:
            thing: What was found.
            number: Its id.

        Returns:
            The object.
        """
        kinds = {str(kind): chance for kind, chance in thing.kind_probabilities.items()}
        return cls(number, thing.outline, thing.std, thing.score, thing.reason, kinds | {OTHER: thing.score})

    @property
    def x(self) -> float:
        """The x of the middle of its outline's extent (m), map frame."""
        return float(self._middle[0])

    @property
    def y(self) -> float:
        """The same along y."""
        return float(self._middle[1])

    @property
    def extent(self) -> tuple[float, float]:
        """How far its outline extends (m) along x and along y."""
        along_x, along_y = np.ptp(self.outline, axis=0).tolist()
        return along_x, along_y

    @property
    def _middle(self) -> FloatArray:
        middle: FloatArray = (self.outline.min(axis=0) + self.outline.max(axis=0)) / 2
        return middle

    def to_json(self) -> dict[str, Any]:
        """Return the object as the report holds it."""
        numbers = {"std_m": self.std, "score": self.score}
        return {"id": self.id, "outline": self.outline.tolist()} | numbers | {"reason": self.reason}


def found_objects(result: DetectionResult | None) -> tuple[FoundObject, ...]:
    """Return the objects of a detection, highest score first; none where detection was skipped."""
    if result is None:
        return ()
    pairs = zip(result.object_ids, result.detections.objects, strict=True)
    return tuple(FoundObject.of(thing, number) for number, thing in pairs)
