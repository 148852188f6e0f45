"""Posteriors by parts of the scans, where scans disagree by more than noise.

Where poses are off, or a shape is none of those that are compared, one of the hypotheses wins by much although none
is right, and half of the scans may prefer another one. The mean of the posteriors by parts of the data is sure where
all of them are (bagged posteriors: Bühlmann 2014; Huggins and Miller 2023).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from detect.refinement.candidates import Candidate
from detect.refinement.fitting.evidence import compare_kinds, laplace_evidence
from detect.refinement.fitting.fit import fit_all_kinds
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.options import OtherOptions
from detect.refinement.other import Alternative, free_alternatives, other_probability
from prim.shapes import Kind


@dataclass(frozen=True)
class PartialPosterior:
    """What the rays of a part of the scans say of a candidate.

    Attributes:
        kind_probabilities: Posterior probabilities of the kinds, given that it is one.
        other_probability: That of «none of the kinds».
    """

    kind_probabilities: Mapping[Kind, float]
    other_probability: float


def partial_posteriors(
    candidate: Candidate,
    candidates: Sequence[Candidate],
    larger: Sequence[Alternative],
    sensor: BeamModel,
    other: OtherOptions,
) -> list[PartialPosterior]:
    """Compare kinds, and none of them, by each part of the scans.

    Args:
        candidate: The fitted candidate.
        candidates: All candidates.
        larger: Alternatives that are not asked again: the parts of something larger.
        sensor: The sensor.
        other: The prior of «none of the kinds», and into how many parts the scans are parted: the parts see it from
            the same sides, since every so many-th scan makes one.

    Returns:
        The posteriors; none of a part that no kind is possible by.
    """
    scans, number = np.unique(candidate.fitted_rays.scan, return_inverse=True)
    if len(scans) < other.bagged_parts:
        return []
    others = [one for one in candidates if one is not candidate]
    found = []
    for part in range(other.bagged_parts):
        half = _by_rays(candidate, number % other.bagged_parts == part, sensor)
        bundle, options = half.fitted_rays, half.options
        posterior = compare_kinds(half.fits, bundle, sensor, candidate.is_possible, options.evidence)
        if posterior is not None:
            alternatives = [*free_alternatives(half, bundle, others, sensor), *larger]
            likeliest = max(posterior.kind_probabilities.values())
            chance = other_probability(alternatives, likeliest, other)
            found.append(PartialPosterior(posterior.kind_probabilities, chance))
    return found


def _by_rays(candidate: Candidate, chosen: np.ndarray, sensor: BeamModel) -> Candidate:
    """Return a candidate that all kinds are fitted to by some of its rays (N,)."""
    rays, options = candidate.fitted_rays.select(chosen), candidate.options
    part = Candidate(candidate.start, rays, candidate.cells, options=options, walls=candidate.walls)
    fits = fit_all_kinds(candidate.current, candidate.fits, rays, sensor, options.fit)
    fits.sort(key=lambda fit: -laplace_evidence(fit, sensor.dispersion, options.evidence))
    part.set_fits(fits, rays, sensor)
    return part
