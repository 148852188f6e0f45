"""Range bias, beams of a width and mixed pixels: found, corrected, and not told where there are none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from detect.detection import SensorErrors
from detect.refinement import refine
from detect.refinement.fitting.evidence import Posterior
from detect.refinement.fitting.fit import KindFit
from detect.refinement.likelihood.geometry import JACOBIANS, parameters_of, ranges_to
from detect.refinement.likelihood.kernels import BACKGROUND, FAR, OCCLUSION, RANGE
from detect.refinement.likelihood.rays import RayBundle
from detect.refinement.likelihood.scanner_errors import ScannerErrors, Surroundings, without_errors
from detect.refinement.likelihood.sensor_model import Background, BeamModel, occlusion_by
from detect.refinement.refine import Refinement
from detect.refinement.scanner_errors import BiasExpansion, Profile, common_step, errors_of, with_shared_errors
from detect.refinement.surroundings.levels import MapLevels
from prim.se2 import rotate
from prim.shapes import Kind, Primitive
from replay.notes import sensor_notes
from tests.detect.refinement.rooms import mapped, room, scans, shape

NOISE = 0.02
WORLD = room(shape(Kind.SQUARE, -0.45, 0.4), shape(Kind.CIRCLE, 0.45, 0.4), shape(Kind.TRIANGLE, 0.0, -0.45))


def measured(bias: float = 0.0, width: float = 0.0, reading: str = "nearest", parts: int = 21, seed: int = 5):
    """Scans of WORLD: of beams of some width (rad), read as the nearest or the mean surface, and a bias (m)."""
    rng, made = np.random.default_rng(seed), []
    for scan, pose in scans(WORLD, 0.0, rays=300, stops=6):
        turns = width * np.linspace(-0.5, 0.5, parts) if width else (0.0,)
        beams = rotate(scan.directions, pose.theta)
        ranges = np.stack([WORLD.cast((pose.x, pose.y), rotate(beams, turn)) for turn in turns])
        exact = ranges.min(axis=0) if reading == "nearest" else ranges.mean(axis=0)
        noisy = exact + bias + rng.normal(0, NOISE, len(exact))
        made.append((replace(scan, ranges=noisy.astype(np.float32)), pose))
    return made


def refined(taken) -> tuple[list[float], SensorErrors | None, list[float]]:
    """Errors (m) of the sizes, what was found of the scanner, and the errors in standard deviations."""
    refinement = Refinement(MapLevels.of(mapped(taken)), threads=1)
    starts = [replace(true, x=true.x + 0.004, y=true.y - 0.003) for true in WORLD.primitives]
    errors, normal = [], []
    for result, true in zip(refinement.run(starts, taken), WORLD.primitives, strict=True):
        assert result is not None and result.primitive.kind is true.kind
        for name, size, wanted in zip(true.kind.sizes, result.primitive.size, true.size, strict=True):
            errors.append(size - wanted)
            normal.append((size - wanted) / result.std[name])
    return errors, refinement.sensor, normal


@pytest.mark.parametrize("bias", [0.02, -0.02])
def test_a_range_bias_is_found_and_corrected(bias: float) -> None:
    exact, nothing, _ = refined(measured())
    errors, found, normal = refined(measured(bias))
    assert nothing is None and found is not None and found.range_bias_std is not None and found.nearest_within == 0
    assert abs(found.range_bias - bias) < 3 * found.range_bias_std < 0.005
    assert errors == pytest.approx(exact, abs=0.001) and np.abs(normal).max() < 4


def test_without_errors_nothing_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit: the search leaves no trace."""
    errors, found, normal = refined(measured())
    monkeypatch.setattr(refine, "correct_scanner_errors", lambda pool, candidates, sensor, noise_std: sensor)
    monkeypatch.setattr(refine, "settle_scanner_errors", lambda pool, candidates, sensor, noise_std: (sensor, None))
    assert found is None and refined(measured()) == (errors, None, normal)


def test_beams_that_read_the_nearest_surface_are_found_and_sizes_are_right() -> None:
    width = math.radians(1.0)
    errors, found, normal = refined(measured(width=width))
    assert found is not None and found.range_bias == 0 and found.mixed_within == 0
    assert found.nearest_within == pytest.approx(width, rel=0.2)
    assert np.abs(errors).max() < 0.0025 and np.abs(normal).max() < 4


def test_mixed_pixels_are_found_and_left_out() -> None:
    errors, found, normal = refined(measured(width=math.radians(1.0), reading="mean"))
    assert found is not None and found.mixed_within > math.radians(0.4) and found.nearest_within == 0
    assert np.abs(errors).max() < 0.003 and np.abs(normal).max() < 4


def bundle_of(rays: np.ndarray) -> RayBundle:
    count = rays.shape[1]
    return RayBundle(rays, np.zeros(count, np.int8), np.zeros(count), np.full(count, 5.0), np.zeros(count, np.int32))


def rays_along_x(*offsets: float) -> np.ndarray:
    """Rays from x = -1 along x, at some y (m)."""
    rays = np.zeros((7, len(offsets)))
    rays[0], rays[1], rays[2] = -1.0, offsets, 1.0
    rays[RANGE] = 2.5
    return rays


def without(rays: np.ndarray, errors: ScannerErrors, walls: tuple[Primitive, ...] = ()) -> np.ndarray:
    """The rays of a bundle whose background is 2.5 m away, without errors, for a circle of 0.1 m at the origin."""
    count = rays.shape[1]
    background = Background(np.full(count, 2.5), np.ones(count, np.bool_), np.zeros(count, np.bool_), 0.005)
    met = occlusion_by(bundle_of(rays), walls, errors.reach)
    around = Surroundings(background, np.full(count, -1.5), met, np.full(count, FAR))
    circle = Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,))
    return without_errors(bundle_of(rays), around, circle, BeamModel.create(NOISE, 5.0), errors).rays


def test_a_bias_shifts_ranges_and_what_the_map_has_alike() -> None:
    wall = Primitive(Kind.RECTANGLE, 1.0, 0.0, math.pi / 2, (1.0, 0.002))
    plain, shifted = (without(rays_along_x(0.3), ScannerErrors(bias), (wall,)) for bias in (0.0, 0.03))
    assert shifted[RANGE, 0] == pytest.approx(plain[RANGE, 0] - 0.03)
    assert shifted[OCCLUSION, 0] == pytest.approx(plain[OCCLUSION, 0] - 0.03) and plain[OCCLUSION, 0] < FAR
    assert shifted[BACKGROUND, 0] == pytest.approx(plain[BACKGROUND, 0])


def test_a_wide_beam_meets_what_any_part_of_it_meets() -> None:
    """At 1 m a reach of 0.01 rad is 10 mm: a ray that passes by 8 mm hits, one by 15 mm does not."""
    circle = Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,))
    turned = without(rays_along_x(0.0, 0.108, 0.115, -0.108, -0.115), ScannerErrors(reach=0.01))
    assert (ranges_to(circle, turned) < FAR).tolist() == [True, True, False, True, False]


def test_near_a_silhouette_a_wide_beam_is_turned_inwards_and_reads_what_is_nearest() -> None:
    """The near end of a plate that is seen at a slant is its silhouette."""
    plate, rays = Primitive(Kind.RECTANGLE, 0.0, 0.0, math.pi / 4, (0.4, 0.02)), rays_along_x(-0.135)
    background = Background(np.full(1, 2.5), np.ones(1, np.bool_), np.zeros(1, np.bool_), 0.005)
    nothing, sensor = np.full(1, FAR), BeamModel.create(NOISE, 5.0)
    around = Surroundings(background, np.full(1, -1.5), nothing, nothing)
    turned = without_errors(bundle_of(rays), around, plate, sensor, ScannerErrors(reach=0.01)).rays
    parts = rays_along_x(*np.full(201, -0.135))
    parts[2], parts[3] = np.cos(turns := np.linspace(-0.01, 0.01, 201)), np.sin(turns)
    nearest = ranges_to(plate, parts).min()
    assert turned[3, 0] == pytest.approx(math.sin(0.01))
    residual = turned[RANGE, 0] - ranges_to(plate, turned)[0]
    assert residual == pytest.approx(rays[RANGE, 0] - nearest, abs=1e-3)


def test_only_readings_between_two_surfaces_at_a_silhouette_are_left_out() -> None:
    rays = rays_along_x(0.1, 0.1, 0.1, 0.0)
    rays[RANGE] = (1.5, 0.97, 2.5, 1.5)
    rays[BACKGROUND] = -9.0
    count = rays.shape[1]
    background = Background(np.full(count, 2.5), np.ones(count, np.bool_), np.zeros(count, np.bool_), 0.005)
    nothing = np.full(count, FAR)
    around = Surroundings(background, np.where(rays[RANGE] == 2.5, -1.0, -9.0), nothing, nothing)
    circle = Primitive(Kind.CIRCLE, 0.0, 0.0, None, (0.1,))
    errors = ScannerErrors(mixed=0.01)
    corrected = without_errors(bundle_of(rays), around, circle, BeamModel.create(NOISE, 5.0), errors)
    assert (corrected.rays[OCCLUSION] == 0).tolist() == [True, False, False, False]


def expansion(step: float, std: float) -> BiasExpansion:
    fit = KindFit(Kind.CIRCLE, np.zeros(5), 0.0, np.eye(3))
    return BiasExpansion(fit, 0.0, -step / std**2, 1 / std**2, np.zeros(5))


def test_candidates_that_agree_give_their_weighted_mean_and_others_have_no_part() -> None:
    sensor = BeamModel.create(NOISE, 5.0)
    agreeing = [expansion(0.010, 0.001), expansion(0.011, 0.001), expansion(0.010, 0.001)]
    mean, std = common_step(Profile(ScannerErrors(), agreeing), sensor)
    assert mean == pytest.approx(0.031 / 3) and std == pytest.approx(0.001 / math.sqrt(3))
    with_other = common_step(Profile(ScannerErrors(), [*agreeing, expansion(-0.05, 0.001)]), sensor)
    assert with_other == pytest.approx((mean, std))


def test_candidates_that_disagree_leave_the_bias_unsure() -> None:
    sensor = BeamModel.create(NOISE, 5.0)
    scattered = [expansion(step, 0.001) for step in (-0.02, -0.008, 0.004, 0.012, 0.03)]
    mean, std = common_step(Profile(ScannerErrors(), scattered), sensor)
    assert std == pytest.approx(np.std([-0.02, -0.008, 0.004, 0.012, 0.03], ddof=1) / math.sqrt(5))
    assert abs(mean) < 5 * std
    assert common_step(Profile(ScannerErrors(), []), sensor) == (0.0, math.inf)


def test_what_is_unsure_about_the_scanner_adds_to_a_primitive() -> None:
    square = shape(Kind.SQUARE)
    covariance = np.diag([1e-6, 1e-6, 1e-4, 1e-6])
    std = dict(zip(square.kind.parameters, np.sqrt(np.diag(covariance)).tolist(), strict=True))
    before = Posterior(square, std, covariance, {}, 0.0)
    shared = np.array([[0.0, 0.0, 0.0, 0.002, 0.002]]).T
    after = with_shared_errors(before, shared)
    assert after.std["side"] == pytest.approx(math.hypot(0.001, 0.002)) and after.std["x"] == before.std["x"]
    assert with_shared_errors(before, None) is before
    assert JACOBIANS[square.kind].shape == (5, 4) and parameters_of(square).shape == (5,)


def test_errors_are_told_in_words() -> None:
    assert sensor_notes(None) == [] and errors_of(None) == ScannerErrors()
    found = SensorErrors(-0.0123, 0.0004, math.radians(1.0), math.radians(2.0))
    bias, nearest, mixed = sensor_notes(found)
    assert "12.3 ± 0.4 mm too short" in bias and "1.0° wide" in nearest and "2.0° wide" in mixed
    assert errors_of(found) == ScannerErrors(-0.0123, math.radians(0.5), math.radians(1.0))
