"""Replays that would take more memory than is allowed are refused."""

from pathlib import Path

import pytest

from mapping.grid import GridFrame
from prim.errors import LogReadError, UsageError
from prim.log import open_log
from prim.memory import machine_memory
from replay.mapping.memory import MemoryBudget
from replay.options import ReplayOptions
from replay.pipeline import Pipeline
from replay.scans.scan_log import ScanLog
from tests.encodings.ros2 import write_mcap
from tests.prim.log.small_log import small_log

FRAME = GridFrame(0.01, 0, 0, 1000, 1000)


def budget(mapper: str, gigabytes: float | None = None) -> MemoryBudget:
    return MemoryBudget(Path("a.mcap"), ReplayOptions(mapper=mapper, max_memory=gigabytes), FRAME)


def test_forward_takes_16_bytes_a_ray() -> None:
    """0.3 GB, a million cells of 100 bytes, and the rays."""
    budget("forward", 2.0).check(100_000_000)
    with pytest.raises(LogReadError, match=r"--stride 2, or allow it with --max-memory 2\.1$"):
        budget("forward", 2.0).check(100_000_001)
    with pytest.raises(LogReadError, match=r"--stride 11, or"):
        budget("forward", 2.0).check(1_050_000_000)


def test_other_mappers_keep_no_rays() -> None:
    budget("det,prob", 0.4).check(10**15)


def test_cells_that_are_too_many_are_refused_before_the_first_scan() -> None:
    with pytest.raises(LogReadError, match=r"take about 0\.4 GB.*allow it with --max-memory 0\.5"):
        budget("forward", 0.3999).check(0)


def test_half_of_the_machine_is_allowed() -> None:
    rays = int((machine_memory() / 2 - 0.4e9) / 16)
    budget("forward").check(rays - 1)
    with pytest.raises(LogReadError):
        budget("forward").check(rays + 2)


def test_no_memory_is_no_option() -> None:
    with pytest.raises(UsageError, match="--max-memory is 0"):
        ReplayOptions(max_memory=0.0)


def test_a_replay_is_refused_before_its_first_scan(tmp_path: Path) -> None:
    path = write_mcap(small_log(scans=40), tmp_path)
    seen: list[int] = []
    options = ReplayOptions(mapper="forward", standing_still=True, resolution=0.05, max_memory=0.30135)
    pipeline = Pipeline(path, options, progress=lambda done, total: seen.append(done))
    with open_log(path) as log:
        assert ScanLog(log, options.selection).expected_rays == 40 * 180
    with pytest.raises(LogReadError, match="--max-memory"):
        pipeline.run()
    assert seen == []
