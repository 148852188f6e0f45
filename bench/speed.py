"""Speed and memory of prim; mapping beside MRPT and reading beside mcap's own reader, in turns: times drift.

    python -m bench.speed [--rounds 5] [--peers ../shared/peers] [--update docs/speed.md]

The peer is MRPT's COccupancyGridMap2D::insertObservation (Debian: libmrpt-maps-dev, cmake, g++), built in a temporary
folder from the peers' sources; without them its rows are left out. Mapping runs on one core, whole commands on all.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from bench.maps import update
from mapping.mapper import make_mapper
from prim.log import open_log
from prim.log.messages import (
    ODOM_TOPIC,
    ODOMETRY_TYPE,
    SCAN_TOPIC,
    SCAN_TYPE,
    decode_scan,
    encode_odometry,
    encode_scan,
)
from prim.log.writer import LogWriter
from prim.scan import Scan
from prim.se2 import Pose2D
from recorder.session import SessionOptions, record_session

BIN = Path(sys.executable).parent
SCANS, RAYS = 100, 500
TURNS = 4
"""Number of times that the peer and each mapper are run in turn in a round."""

Rows = dict[str, list[float]]


def room() -> tuple[list[Scan], list[Pose2D]]:
    """Return the peers' workload: 100 scans of 500 rays in a room of 2 x 2 m with two circles and two boxes."""
    import scans  # a module of the peers' sources

    poses, bearings, ranges, _ = scans.make()
    increment = float(bearings[1] - bearings[0])
    workload = [Scan(0, "laser", float(bearings[0]), increment, 0.03, 10.0, row.astype(np.float32)) for row in ranges]
    return workload, [Pose2D(*pose) for pose in poses.tolist()]


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


@contextmanager
def one_core() -> Iterator[None]:
    """Restrict this process, and those that it starts, to one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def mapping_rate(name: str, scans: list[Scan], poses: list[Pose2D]) -> float:
    """Measure the rays per second of a mapper: the best of 11 maps, as the peer's program reports it.

    The best run is the one least disturbed by other processes; medians of such short runs are noise.

    Args:
        name: Name of the mapper.
        scans: The scans.
        poses: The laser's poses.

    Returns:
        Rays per second.
    """

    def work() -> None:
        mapper = make_mapper(name, 0.01, (-1.0, -1.0, 1.0, 1.0))
        for scan, pose in zip(scans, poses, strict=True):
            mapper.update(scan, pose)

    return SCANS * RAYS / min(seconds(work) for _ in range(11))


def build_peer(peers: Path, folder: Path) -> Path | None:
    """Build the peer's program.

    Args:
        peers: The folder of its sources.
        folder: Where it is built.

    Returns:
        The program; None where it cannot be built.
    """
    if not (peers / "bench_mrpt.cpp").exists() or not shutil.which("cmake"):
        return None
    for file in peers.iterdir():
        shutil.copy(file, folder / file.name)
    steps = (["cmake", "-S", ".", "-B", "b"], ["cmake", "--build", "b"], [sys.executable, "scans.py"])
    built = all(subprocess.run(step, cwd=folder, capture_output=True, check=False).returncode == 0 for step in steps)
    return folder / "b" / "bench_mrpt" if built else None


def peer_rate(program: Path) -> float:
    """Return MRPT's rays per second: the best of 11 maps, without beam widening."""
    printed = subprocess.run([program], cwd=program.parents[1], capture_output=True, text=True, check=True).stdout
    found = re.search(r"widening=0 best (\d+) rays/s", printed)
    assert found, printed
    return float(found[1])


def long_log(path: Path, scans: int, beams: int) -> None:
    """Write a log of a robot that drives in circles, with 10 scans a second and odometry with each.

    Args:
        path: The log.
        scans: Number of scans.
        beams: Number of beams of each.
    """
    rng = np.random.default_rng(0)
    ranges = rng.uniform(0.3, 3.0, (64, beams)).astype(np.float32)
    with LogWriter(path) as log:
        log.add_topic(SCAN_TOPIC, SCAN_TYPE)
        log.add_topic(ODOM_TOPIC, ODOMETRY_TYPE)
        for index in range(scans):
            stamp = (index + 1) * 100_000_000
            scan = Scan(stamp, "base_link", -3.14, 6.28 / beams, 0.03, 5.0, ranges[index % 64])
            log.write(SCAN_TOPIC, stamp, encode_scan(scan))
            turn = 0.01 * index
            log.write(ODOM_TOPIC, stamp, encode_odometry(stamp, Pose2D(np.cos(turn), np.sin(turn), turn % 6.28)))


def scans_of(log: Path) -> Iterator[Scan]:
    with open_log(log) as reader:
        for _, scan in reader.decoded(reader.topics[SCAN_TOPIC], decode_scan):
            yield scan


def scans_by_mcap(log: Path) -> Iterator[Scan]:
    """Yield a log's scans, their messages by mcap's own reader: in the order of time, CRCs checked, as by ours."""
    with log.open("rb") as stream:
        for _, _, message in make_reader(stream, validate_crcs=True).iter_messages([SCAN_TOPIC]):
            yield decode_scan(message.data)


def reading_rate(scans: Iterator[Scan]) -> float:
    """Return the number of decoded scans per second."""
    began = time.perf_counter()
    return sum(1 for _ in scans) / (time.perf_counter() - began)


def command(folder: Path, *arguments: object) -> tuple[float, int]:
    """Run a command.

    Args:
        folder: Its working directory.
        arguments: The program and its arguments.

    Returns:
        Wall time (s) and peak memory (KiB).
    """
    before = time.perf_counter()
    process = subprocess.Popen([str(argument) for argument in arguments], cwd=folder, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0, arguments
    return time.perf_counter() - before, usage.ru_maxrss


def recording_rate(folder: Path, motion: str, session_seconds: float) -> float:
    """Measure recording, within this process.

    Args:
        folder: Where the logs go.
        motion: «warp» or «drive».
        session_seconds: Duration of the session (s).

    Returns:
        Session time over wall time.
    """
    stops = (round(session_seconds * 10 / 20), 20)
    options = SessionOptions(seed=1, motion=motion, stops=stops, duration=session_seconds)
    session = record_session(folder / "warm.mcap", SessionOptions(seed=1, stops=(2, 2)))
    wall_time = seconds(lambda: record_session(folder / "r.mcap", options))
    assert session.scans
    with open_log(folder / "r.mcap") as log:
        return log.topics[SCAN_TOPIC].messages / 10 / wall_time


def measure(rounds: int, peer: Path | None, folder: Path) -> Rows:
    """Measure everything, round by round.

    Args:
        rounds: Number of rounds.
        peer: The peer's program; None: it is left out.
        folder: Where all files go.

    Returns:
        The values of each measurement.
    """
    rows: Rows = defaultdict(list)
    scans, poses = room()
    long_log(folder / "read.mcap", 10_000, 500)
    session = folder / "s.mcap"
    record_session(session, SessionOptions(seed=10))
    replay = BIN / "prim-replay"
    for _ in range(rounds):
        with one_core():
            for _ in range(TURNS):
                if peer:
                    rows["mrpt"].append(peer_rate(peer))
                for name in ("det", "prob"):
                    rows[name].append(mapping_rate(name, scans, poses))
        rows["reading"].append(reading_rate(scans_of(folder / "read.mcap")))
        rows["reading by mcap"].append(reading_rate(scans_by_mcap(folder / "read.mcap")))
        for motion in ("warp", "drive"):
            rows[f"recording {motion}"].append(recording_rate(folder, motion, 60.0))
        rows["numpy"].append(command(folder, sys.executable, "-c", "import numpy")[0])
        rows["help"].append(command(folder, replay, "--help")[0])
        rows["replay"].append(command(folder, replay, session, "--no-viewer", "--mapper", "det", "--quiet")[0])
        for mapper in ("det", "prob"):
            command(folder, replay, session, "--mapper", mapper, "--quiet", "--report", folder / "r.json")
            timing = json.loads((folder / "r.json").read_text())["timing"]
            rows[f"viewer {mapper}"].append(timing["viewer_s"] / timing["total_s"])
    for minutes in (1, 60):
        log = folder / f"{minutes}.mcap"
        long_log(log, minutes * 600, 180)
        for name, options in (("no viewer", ["--no-viewer"]), ("viewer", [])):
            memory = command(folder, replay, log, "--mapper", "det", "--resolution", 0.05, "--quiet", *options)[1]
            rows[f"memory {minutes} {name}"].append(memory / 1024)
    return rows


def table(rows: Rows) -> str:
    """Return the medians as a Markdown table; of mapping, the best runs and their ratios to the peer's."""
    middle = {name: statistics.median(values) for name, values in rows.items()}
    ratios = {name: max(rows[name]) / max(rows["mrpt"]) for name in ("det", "prob") if "mrpt" in rows}
    middle |= {name: max(rows[name]) for name in ("det", "prob", "mrpt") if name in rows}
    lines = ["| measurement | value | relative |", "|---|---|---|"]
    if "mrpt" in rows:
        lines.append(f"| MRPT insertObservation, one core | {middle['mrpt'] / 1e6:.2f} M rays/s | 1 |")
    for name in ("det", "prob"):
        relative = f"{ratios[name]:.2f} x MRPT" if ratios else "–"
        lines.append(
            f"| `{name}` through the public mapper, one core | {middle[name] / 1e6:.2f} M rays/s | {relative} |"
        )
    share = statistics.median(a / b for a, b in zip(rows["help"], rows["numpy"], strict=True))
    faster = statistics.median(a / b for a, b in zip(rows["reading"], rows["reading by mcap"], strict=True))
    lines += [
        f"| reading, decoded scans of 500 beams | {middle['reading']:,.0f} scans/s | {faster:.2f} x mcap's reader |",
        f"| recording, warp | {middle['recording warp']:.0f} x real time | – |",
        f"| recording, drive | {middle['recording drive']:.0f} x real time | – |",
        f"| `prim-replay --no-viewer --mapper det`, 85 scans, with start-up | {middle['replay']:.2f} s | – |",
        f"| `prim-replay --help` | {middle['help']:.2f} s | {share:.2f} x `import numpy` |",
        f"| viewer's share of a replay, det / prob | {middle['viewer det']:.0%} / {middle['viewer prob']:.0%} | – |",
        f"| peak memory, 1 / 60 minutes of log, no viewer | {middle['memory 1 no viewer']:.0f} / "
        f"{middle['memory 60 no viewer']:.0f} MiB | "
        f"{middle['memory 60 no viewer'] / middle['memory 1 no viewer']:.2f} |",
        f"| peak memory, 1 / 60 minutes of log, saving an .rrd | {middle['memory 1 viewer']:.0f} / "
        f"{middle['memory 60 viewer']:.0f} MiB | {middle['memory 60 viewer'] / middle['memory 1 viewer']:.2f} |",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--peers", type=Path, default=Path(__file__).parents[2] / "shared" / "peers")
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    sys.path.insert(0, str(options.peers))
    with tempfile.TemporaryDirectory() as scratch:
        peer = build_peer(options.peers, Path(scratch))
        if peer is None:
            print("MRPT cannot be built here (Debian: cmake g++ libmrpt-maps-dev): its rows are left out")
        rows = measure(options.rounds, peer, Path(scratch))
    content = table(rows)
    print(content)
    if options.update:
        update(options.update, "bench-speed", content)


if __name__ == "__main__":
    main()
