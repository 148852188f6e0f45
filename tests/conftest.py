import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from prim.scan import Scan
from recorder.sensors import Lidar
from recorder.session import Session, SessionOptions, record_session
from recorder.world import WorldOptions

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # as a shell starts what runs in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):  # which nohup has ignored
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

settings.register_profile("prim", deadline=None)
settings.load_profile("prim")

DATA = Path(os.environ.get("PRIM_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture
def real_log() -> Callable[[str], Path]:
    """Return a function that finds a public log by name, and skips the test where it is not at hand."""

    def find(name: str) -> Path:
        path = DATA / name
        if not path.exists():
            pytest.skip(f"the public log {name} is not here (looked in {DATA}; PRIM_TEST_DATA names another folder)")
        return path

    return find


@pytest.fixture(scope="session")
def quiet_session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A recorded session without any LiDAR noise."""
    path = tmp_path_factory.mktemp("quiet") / "quiet.mcap"
    world = WorldOptions(per_kind=(1, 1))
    return record_session(path, SessionOptions(seed=11, world=world, lidar=Lidar(noise_std=0.0)))


@pytest.fixture(scope="session")
def noisy_session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A small recorded session with noise: 5 x 5 stops, 180 rays."""
    path = tmp_path_factory.mktemp("noisy") / "noisy.mcap"
    return record_session(path, SessionOptions(seed=5, stops=(5, 5), lidar=Lidar(rays=180)))


@pytest.fixture
def in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Run the test in an empty folder."""
    monkeypatch.chdir(tmp_path)
    yield tmp_path


def scan_of(*ranges: float, angle_min: float = 0.0, increment: float = np.pi / 2, **limits: float) -> Scan:
    """A scan for tests: ranges at bearings 0, 90, ... degrees, 0.01 to 5 m."""
    values = np.array(ranges, dtype=np.float32)
    range_min, range_max = limits.get("range_min", 0.01), limits.get("range_max", 5.0)
    return Scan(10**9, "laser", angle_min, increment, range_min, range_max, values)


@pytest.fixture
def make_scan() -> Callable[..., Scan]:
    return scan_of
