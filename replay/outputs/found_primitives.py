"""The primitives that a replay found, as reports, tables and the API give them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from detect.detection import OTHER
from prim.shapes import Kind, Primitive
from replay.detection.stage import DetectionResult

if TYPE_CHECKING:
    from detect.detection import Detection


@dataclass(frozen=True)
class FoundPrimitive:
    """A primitive that was found.

    Attributes:
        id: Its number: that of its track, where primitives were detected along the way.
        kind: Its kind; compares equal to its name, such as «circle».
        x: The area centroid's x in the map frame (m).
        y: The same along y (m).
        theta: Its heading (rad); None where the kind has none.
        size: Its sizes by name (m), such as ``radius``.
        score: 0 to 1: after refinement the posterior probability of its kind, else the network's score.
        stage: «refined»: fitted to the rays; «detected»: estimated by the networks alone.
        std: Standard deviations by name (m, rad): x, y, theta and the sizes; None where it was not refined.
        chances: The posterior probability of each kind by its name, and as ``other`` that of none of them; None where
            it was not refined.
    """

    id: int
    kind: Kind
    x: float
    y: float
    theta: float | None
    size: Mapping[str, float]
    score: float
    stage: str
    std: Mapping[str, float] | None
    chances: Mapping[str, float] | None

    @classmethod
    def of(cls, detection: Detection, number: int) -> FoundPrimitive:
        """Return a detection under a number.

        Args:
            detection: The detection.
            number: Its id.

        Returns:
            The primitive that was found.
        """
        primitive, chances = detection.primitive, detection.kind_probabilities
        return cls(
            id=number,
            kind=primitive.kind,
            x=primitive.x,
            y=primitive.y,
            theta=primitive.theta,
            size=primitive.sizes,
            score=detection.score,
            stage="detected" if detection.std is None else "refined",
            std=detection.std,
            chances=None if chances is None else _by_name(chances) | {OTHER: detection.other_probability},
        )

    @property
    def primitive(self) -> Primitive:
        """Kind, pose and size alone."""
        return Primitive(self.kind, self.x, self.y, self.theta, tuple(self.size[name] for name in self.kind.sizes))

    def to_json(self) -> dict[str, Any]:
        """Return the primitive as the report holds it."""
        std, chances = (None if values is None else dict(values) for values in (self.std, self.chances))
        found = {"score": self.score, "stage": self.stage, "std": std, "chances": chances}
        return {"id": self.id} | self.primitive.to_json() | found


def _by_name(chances: Mapping[Kind, float]) -> dict[str, float]:
    return {str(kind): chance for kind, chance in chances.items()}


def found_primitives(result: DetectionResult | None) -> tuple[FoundPrimitive, ...]:
    """Return the primitives of a detection, highest score first; none where detection was skipped."""
    if result is None:
        return ()
    pairs = zip(result.identities, result.detections.found, strict=True)
    return tuple(FoundPrimitive.of(detection, identity.id) for identity, detection in pairs)
