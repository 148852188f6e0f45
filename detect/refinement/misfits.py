"""Candidates that no kind fits: found early, so that they do not spoil what is estimated of the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

from detect.refinement.candidates import Candidate
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.sensor_model import BeamModel
from detect.refinement.outlines.free_outline import OutlineCost, StarOutline, fit_free_outline, score_test
from detect.refinement.sensor_estimation import estimate_noise
from prim.arrays import FloatArray


def find_misfits(
    pool: Executor, candidates: Sequence[Candidate], sensor: BeamModel, beside: Sequence[Candidate] = ()
) -> None:
    """Give a free outline to each candidate whose rays say that no kind fits.

    Candidates whose kind is known already are left as they are.

    Args:
        pool: The threads.
        candidates: The fitted candidates; ``outline`` is set.
        sensor: The sensor so far; its footprint and dispersion are not used, since misfits may have spoilt them.
        beside: Further candidates that may occlude these.
    """
    model = replace(sensor, footprint=candidates[0].options.outline.footprint, dispersion=1.0)
    present = [*candidates, *beside]
    bundles = [candidate.rays_with_background(present, model) for candidate in candidates]
    work = zip(candidates, bundles, strict=True)
    found = pool.map(lambda item: _better_outline(item[0], item[1], model), work)
    for candidate, outline in zip(candidates, found, strict=True):
        candidate.outline = outline


def _better_outline(candidate: Candidate, bundle: RayBundle, sensor: BeamModel) -> FloatArray | None:
    """Return the free outline (V, 2) in m that is likelier than a candidate's primitive; None where none is."""
    options = candidate.options.outline
    if candidate.known is not None or not len(bundle):
        return None
    star = StarOutline.of(candidate.current, options)
    cost = OutlineCost(star, bundle, sensor, options)
    if score_test(cost, options.test_blur, options)[1] < options.suspicious:
        return None
    fit = fit_free_outline(cost, sensor.footprint, options)
    return star.deformed(fit.coefficients, options) if fit.log_bayes_factor > 0 else None


def sensor_without_misfits(
    pool: Executor, candidates: Sequence[Candidate], sensor: BeamModel, noise_std: float | None
) -> BeamModel:
    """Estimate the noise with free outlines where no kind fits, until neither changes.

    Args:
        pool: The threads.
        candidates: The fitted candidates; ``outline`` is set.
        sensor: The sensor so far.
        noise_std: The range noise (m) where it is known.

    Returns:
        The sensor with that noise.
    """
    options = sensor.options
    for _ in range(options.misfit_rounds):
        find_misfits(pool, candidates, sensor)
        std = noise_std or estimate_noise(candidates, sensor)
        settled = abs(std - sensor.std) < options.same_noise * std
        dropouts = sensor.dropout_share
        sensor = BeamModel.create(std, sensor.span, sensor.footprint, 1.0, sensor.max_std, options, dropouts)
        if settled:
            break
    return sensor
