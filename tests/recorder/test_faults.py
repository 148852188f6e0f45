import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from prim.se2 import Pose2D
from prim.world import World
from recorder.faults import BEAM, FaultGenerators, ScannerFaults, reported_echoes, sub_ray_offsets
from recorder.sensors import Lidar

ROOM = World((4.0, 6.0)).with_walls()
QUIET = Lidar(rays=20_000, noise_std=0.0)


def generators(seed: int = 0) -> FaultGenerators:
    return FaultGenerators.spawned_from(np.random.default_rng(seed))


def ranges(faults: ScannerFaults, lidar: Lidar = QUIET, world: World = ROOM, seed: int = 0) -> np.ndarray:
    scanner = replace(lidar, faults=faults)
    scan = scanner.measure(world, Pose2D(), 0, 0.1, np.random.default_rng(seed), generators(seed))
    return scan.ranges.astype(float)


EXACT = QUIET.exact(ROOM, Pose2D())


@pytest.mark.parametrize("bias", [0.02, -0.013])
def test_a_bias_is_added_to_every_range(bias: float) -> None:
    assert ranges(ScannerFaults(range_bias=bias)) == pytest.approx(EXACT + bias, abs=1e-6)


def test_a_bias_moves_ranges_beyond_the_limits() -> None:
    lidar = replace(QUIET, range_max=2.5, range_min=2.1)
    read = ranges(ScannerFaults(range_bias=0.1), lidar)
    assert np.array_equal(np.isposinf(read), EXACT + 0.1 > 2.5)
    read = ranges(ScannerFaults(range_bias=-0.1), lidar)
    assert np.array_equal(np.isneginf(read), EXACT - 0.1 < 2.1)


def test_noise_grows_with_range() -> None:
    lidar = replace(QUIET, noise_std=0.02)
    errors = ranges(ScannerFaults(noise_growth=0.01), lidar) - EXACT
    expected = np.hypot(0.02, 0.01 * EXACT)
    for near, far in ((2.0, 2.3), (2.3, 3.0), (3.0, 3.6)):
        some = (near <= EXACT) & (far > EXACT)
        assert errors[some].std() == pytest.approx(math.sqrt((expected[some] ** 2).mean()), rel=0.05)
    assert (errors / expected).std() == pytest.approx(1, rel=0.02)


def test_noise_that_grows_leaves_beams_without_return_as_they_are() -> None:
    read = ranges(ScannerFaults(noise_growth=0.01), world=World((1.0, 1.0)))
    assert np.isposinf(read).all()


@pytest.mark.parametrize("quantum", [0.01, 0.25])
def test_ranges_are_multiples_of_the_quantum(quantum: float) -> None:
    read = ranges(ScannerFaults(quantum=quantum), replace(QUIET, noise_std=0.03))
    assert read / quantum == pytest.approx(np.round(read / quantum), abs=1e-4)
    plain = ranges(ScannerFaults(), replace(QUIET, noise_std=0.03))
    assert np.abs(read - plain).max() <= quantum / 2 + 1e-6


@pytest.mark.parametrize(("written", "value"), [("inf", np.inf), ("nan", np.nan), ("0", 0.0), ("max", 5.0)])
def test_dropouts_are_written_as_asked(written: str, value: float) -> None:
    read = ranges(ScannerFaults(dropouts=0.1, dropout_as=written))
    dropped = np.isnan(read) if np.isnan(value) else read == value
    assert dropped.mean() == pytest.approx(0.1, abs=4 * math.sqrt(0.1 * 0.9 / len(read)))
    assert read[~dropped] == pytest.approx(EXACT[~dropped], abs=1e-6)


def test_outliers_are_uniform_between_the_limits() -> None:
    read = ranges(ScannerFaults(outliers=0.3))
    out = np.abs(read - EXACT) > 1e-5
    assert out.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.3 * 0.7 / len(read)))
    shares = (np.sort(read[out]) - 0.032) / (5.0 - 0.032)
    assert np.abs(shares - (np.arange(out.sum()) + 0.5) / out.sum()).max() < 2 / math.sqrt(out.sum())


def test_faults_draw_from_generators_of_their_own() -> None:
    noisy = replace(QUIET, noise_std=0.05)
    plain, faulty = ranges(ScannerFaults(), noisy), ranges(ScannerFaults(dropouts=0.2, outliers=0.1), noisy)
    assert (plain == faulty).mean() == pytest.approx(0.72, abs=0.02)
    fewer = ranges(ScannerFaults(dropouts=0.2), noisy)
    assert np.array_equal(np.isposinf(fewer), np.isposinf(faulty))
    scans = [replace(noisy, faults=ScannerFaults(outliers=0.1)).measure(
        ROOM, Pose2D(), 0, 0.1, np.random.default_rng(4)).ranges for _ in range(2)]  # fmt: skip
    assert np.array_equal(*scans)


def test_wide_beams_read_a_wall_as_narrow_ones_do() -> None:
    """But where it curves within the beam: to second order in its width."""
    read = ranges(ScannerFaults(beam_width=math.radians(1)))
    away = np.ones(len(read), bool)
    bearings = np.linspace(-3.14, 3.14, len(read))
    for corner in np.arctan2([3, 3, -3, -3], [2, -2, 2, -2]):
        away &= np.abs(np.angle(np.exp(1j * (bearings - corner)))) > 0.01
    assert np.abs(read - EXACT)[away].max() < 1e-3


def test_wide_beams_mix_ranges_at_edges() -> None:
    """A beam that half meets a near wall's end and else a far one: the shares of each answer, and how it blurs."""
    world = World((4.0, 6.0), walls=((1.0, 0.0, 1.0, 1.0), (2.0, -3.0, 2.0, 3.0)))
    lidar = replace(QUIET, rays=1, faults=ScannerFaults(beam_width=math.radians(2)))
    chances = generators()
    read = np.array([
        lidar.measure(world, Pose2D(0, 0, 1e-6 + lidar.fov / 2), 0, 0.1, np.random.default_rng(0), chances).ranges[0]
        for _ in range(2000)
    ])  # fmt: skip
    near, far = np.abs(read - 1) < 1e-3, np.abs(read - 2) < 1e-3
    mixed = (read > 1.4) & (read < 1.6)
    assert (near | far | mixed).all()
    assert mixed.mean() == pytest.approx(1 - BEAM.nearest - BEAM.strongest, abs=0.03)
    assert near.mean() == pytest.approx(BEAM.nearest + BEAM.strongest, abs=0.03)  # a tie counts for the nearest
    inside = lidar.measure(world, Pose2D(0, 0, 0.02 + lidar.fov / 2), 0, 0.1, np.random.default_rng(0), chances)
    assert inside.ranges[0] == pytest.approx(1 / math.cos(0.02), abs=1e-3)


DISTANCES = hnp.arrays(np.float64, (4, BEAM.sub_rays), elements=st.floats(0.1, 5) | st.just(math.inf))


@settings(max_examples=100, deadline=None)
@given(DISTANCES, hnp.arrays(np.float64, 4, elements=st.floats(0, 1, exclude_max=True)))
def test_what_is_reported_lies_between_what_is_lit(distances: np.ndarray, draws: np.ndarray) -> None:
    read = reported_echoes(distances, draws)
    lit = np.isfinite(distances)
    for one, row, seen in zip(read, distances, lit, strict=True):
        if np.isfinite(one):
            assert row[seen].min() - 1e-9 <= one <= row[seen].max() + 1e-9
        else:
            assert seen.sum() < BEAM.sub_rays
    nearest = reported_echoes(distances, np.zeros(4))
    assert np.all((nearest <= read + 1e-9) | ~np.isfinite(nearest))


def test_echoes_that_are_weak_are_not_detected() -> None:
    distances = np.full((1, BEAM.sub_rays), np.inf)
    distances[0, 0] = 1.0
    assert np.isposinf(reported_echoes(distances, np.zeros(1)))
    distances[0, : BEAM.sub_rays // 2] = 1.0
    assert reported_echoes(distances, np.zeros(1)) == pytest.approx([1.0])
    distances[0, 0] = 0.5
    assert reported_echoes(distances, np.zeros(1)) == pytest.approx([1.0])


def test_sub_rays_lie_within_the_beam() -> None:
    offsets = sub_ray_offsets(0.02)
    assert len(offsets) == BEAM.sub_rays and offsets.sum() == pytest.approx(0)
    assert offsets[[0, -1]] == pytest.approx([-0.01 * 20 / 21, 0.01 * 20 / 21])
