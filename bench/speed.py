"""Speed and memory of prim; mapping beside MRPT and reading beside mcap's own reader, in turns: times drift.

    python -m bench.speed [--rounds 5] [--peers ../shared/peers] [--update docs/speed.md]

The peer is MRPT's COccupancyGridMap2D::insertObservation (Debian: libmrpt-maps-dev, cmake, g++), built in a temporary
folder from the peers' sources; without them its row is left out. Mapping runs on one core, whole commands on all.
Replays are the command as it is given, with its default mapper, detection, refinement and recording, and beside it
the same without some of these; their times are compared within a round.
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
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from bench.maps import update
from bench.sessions import recorded
from mapping.mapper import make_mapper
from prim.choices import MapperName
from prim.log import open_log
from prim.log.decoding.ros import decode_scan
from prim.log.messages import (
    ODOM_TOPIC,
    ODOMETRY_TYPE,
    SCAN_TOPIC,
    SCAN_TYPE,
    encode_odometry,
    encode_scan,
)
from prim.log.writer import LogWriter
from prim.scan import Scan
from prim.se2 import Pose2D
from prim.shapes import Kind, Primitive
from prim.world import World
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session

REPLAY = Path(sys.executable).parent / "prim-replay"
SCANS, RAYS = 100, 500
ROOM_NOISE = 0.003
"""Standard deviation of the range noise (m) of the workload of mapping."""

TURNS = 4
"""Number of times that the peer and each mapper are run in turn in a round."""

REPLAYS = {
    "": (),
    " --no-detect": ("--no-detect",),
    " --no-viewer": ("--no-viewer",),
    " --no-detect --no-viewer": ("--no-detect", "--no-viewer"),
}
"""Options of the replays that are measured, by what stands behind `prim-replay LOG` in the table."""

ONE_LOOK = ("--detect-every", "end")
"""Options of a replay that detects in the final map alone."""

MAPPED = {MapperName.DET: "only sets states, less work than log-odds", MapperName.PROB: "log-odds"}
"""The mappers that are measured beside MRPT, and what they do to a cell."""

LOOK_MAPPERS = (MapperName.PROB, MapperName.FORWARD)
LOOK_SEED, LOOK_STOPS = 64_000, (11, 11)
"""The sessions of which each round replays one: about 100 scans each, since some stops are taken."""

MINUTES = (1, 60)

Posed = list[tuple[Scan, Pose2D]]
Rows = dict[str, list[float]]


def room() -> Posed:
    """Return the workload of mapping: 100 scans of 500 rays in a room of 2 x 2 m with two circles and two boxes."""
    objects = (
        Primitive(Kind.CIRCLE, -0.5, 0.5, None, (0.12,)),
        Primitive(Kind.CIRCLE, 0.45, -0.35, None, (0.09,)),
        Primitive(Kind.RECTANGLE, 0.4, 0.5, 0.4, (0.3, 0.2)),
        Primitive(Kind.SQUARE, -0.5, -0.5, 0.9, (0.24,)),
    )
    world = World((1.96, 1.96), objects).with_walls()
    rng = np.random.default_rng(0)
    increment = 2 * np.pi / RAYS
    bearings = -np.pi + increment * np.arange(RAYS)
    scans = []
    for turn in 2 * np.pi * np.arange(SCANS) / SCANS:
        pose = Pose2D(0.25 * np.cos(turn), 0.25 * np.sin(turn), turn)
        directions = np.column_stack((np.cos(bearings + turn), np.sin(bearings + turn)))
        ranges = world.cast((pose.x, pose.y), directions) + rng.normal(0.0, ROOM_NOISE, RAYS)
        scans.append((Scan(0, "laser", -np.pi, increment, 0.03, 10.0, ranges.astype(np.float32)), pose))
    return scans


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


def mapping_rate(name: str, scans: Posed) -> float:
    """Measure the rays per second of a mapper: the best of 11 maps, as the peer's program reports it.

    The best run is the one least disturbed by other processes; medians of such short runs are noise.

    Args:
        name: Name of the mapper.
        scans: The scans with the laser's poses.

    Returns:
        Rays per second.
    """

    def work() -> None:
        mapper = make_mapper(name, 0.01, (-1.0, -1.0, 1.0, 1.0))
        for scan, pose in scans:
            mapper.update(scan, pose)

    return SCANS * RAYS / min(seconds(work) for _ in range(11))


def build_peer(peers: Path, folder: Path, scans: Posed) -> Path | None:
    """Build the peer's program, and write the workload that it reads.

    Args:
        peers: The folder of its sources.
        folder: Where it is built.
        scans: The scans with the laser's poses.

    Returns:
        The program; None where it cannot be built.
    """
    if not (peers / "bench_mrpt.cpp").exists() or not shutil.which("cmake"):
        return None
    for name in ("bench_mrpt.cpp", "CMakeLists.txt"):
        shutil.copy(peers / name, folder / name)
    np.array([(pose.x, pose.y, pose.theta) for _, pose in scans], np.float64).tofile(folder / "poses.f64")
    np.array([scan.ranges for scan, _ in scans], np.float32).tofile(folder / "ranges.f32")
    steps = (["cmake", "-S", ".", "-B", "b"], ["cmake", "--build", "b"])
    built = all(subprocess.run(step, cwd=folder, capture_output=True, check=False).returncode == 0 for step in steps)
    return folder / "b" / "bench_mrpt" if built else None


def peer_rate(program: Path) -> float:
    """Return MRPT's rays per second: the best of 11 maps, without beam widening."""
    printed = subprocess.run([program], cwd=program.parents[1], capture_output=True, text=True, check=True).stdout
    found = re.search(r"widening=0 best (\d+) rays/s", printed)
    assert found, printed
    return float(found[1])


def long_log(path: Path, scans: int, beams: int) -> None:
    """Write a log of 10 scans a second, with odometry at each: those of a recorded session, over and over.

    Args:
        path: The log.
        scans: Number of scans.
        beams: Number of beams of each.
    """
    session = recorded(SessionOptions(seed=10, lidar=Lidar(rays=beams))).scans
    with LogWriter(path) as log:
        log.add_topic(SCAN_TOPIC, SCAN_TYPE)
        log.add_topic(ODOM_TOPIC, ODOMETRY_TYPE)
        for index in range(scans):
            scan, pose = session[index % len(session)]
            stamp = (index + 1) * 100_000_000
            log.write(SCAN_TOPIC, stamp, encode_scan(replace(scan, stamp=stamp, frame_id="base_link")))
            log.write(ODOM_TOPIC, stamp, encode_odometry(stamp, pose))


def scans_of(log: Path) -> Iterator[Scan]:
    with open_log(log) as reader:
        for _, scan in reader.decoded(reader.topics[SCAN_TOPIC]):
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


def measure_mapping(rows: Rows, scans: Posed, peer: Path | None) -> None:
    """Add the rays per second of the peer and of the mappers, in turns on one core."""
    with one_core():
        for _ in range(TURNS):
            if peer:
                rows["mrpt"].append(peer_rate(peer))
            for name in MAPPED:
                rows[name].append(mapping_rate(name, scans))


def measure_replays(rows: Rows, folder: Path, session: Path) -> None:
    """Add the seconds of whole commands, and the viewer's share of a replay."""
    rows["numpy"].append(command(folder, sys.executable, "-c", "import numpy")[0])
    rows["help"].append(command(folder, REPLAY, "--help")[0])
    for name, options in REPLAYS.items():
        rows[f"replay{name}"].append(command(folder, REPLAY, session, "--quiet", *options)[0])
    command(folder, REPLAY, session, "--quiet", "--report", folder / "r.json")
    timing = json.loads((folder / "r.json").read_text())["timing"]
    rows["viewer"].append(timing["viewer_s"] / timing["total_s"])


def measure_looks(rows: Rows, folder: Path, seed: int) -> None:
    """Add the time of a replay with its default looks, relative to one with a look at the end alone."""
    log = folder / "looks.mcap"
    record_session(log, SessionOptions(seed=seed, stops=LOOK_STOPS))
    for mapper in LOOK_MAPPERS:
        pair = [command(folder, REPLAY, log, "--quiet", "--mapper", mapper, *look)[0] for look in ((), ONE_LOOK)]
        rows[f"looks {mapper}"].append(pair[0] / pair[1])


def measure_memory(rows: Rows, folder: Path) -> None:
    """Add the peak memory (MiB) of replays of a short and a long log."""
    for minutes in MINUTES:
        log = folder / f"{minutes}.mcap"
        long_log(log, minutes * 600, 180)
        for name, options in REPLAYS.items():
            rows[f"memory {minutes}{name}"].append(command(folder, REPLAY, log, "--quiet", *options)[1] / 1024)


def measure(rounds: int, peers: Path, folder: Path) -> Rows:
    """Measure everything, round by round.

    Args:
        rounds: Number of rounds.
        peers: The folder of the peer's sources.
        folder: Where all files go.

    Returns:
        The values of each measurement.
    """
    rows: Rows = defaultdict(list)
    scans = room()
    peer = build_peer(peers, folder, scans)
    if peer is None:
        print("MRPT cannot be built here (Debian: cmake g++ libmrpt-maps-dev): its row is left out")
    long_log(folder / "read.mcap", 10_000, 500)
    session = folder / "s.mcap"
    rows["scans"].append(record_session(session, SessionOptions(seed=10)).scans)
    for mapper in LOOK_MAPPERS:
        command(folder, REPLAY, session, "--quiet", "--mapper", mapper)  # compiles what is not in the cache yet
    for turn in range(rounds):
        measure_mapping(rows, scans, peer)
        rows["reading"].append(reading_rate(scans_of(folder / "read.mcap")))
        rows["reading by mcap"].append(reading_rate(scans_by_mcap(folder / "read.mcap")))
        for motion in ("warp", "drive"):
            rows[f"recording {motion}"].append(recording_rate(folder, motion, 60.0))
        measure_replays(rows, folder, session)
        measure_looks(rows, folder, LOOK_SEED + turn)
    measure_memory(rows, folder)
    return rows


def table(rows: Rows) -> str:
    """Return the medians as a Markdown table; of mapping, the best runs and their ratios to the peer's."""
    lines = ["| measurement | value | relative |", "|---|---|---|"]
    return "\n".join([*lines, *mapping_lines(rows), *command_lines(rows), *memory_lines(rows)])


def mapping_lines(rows: Rows) -> Iterator[str]:
    """Yield the rows of mapping."""
    best = {name: max(rows[name]) for name in ("mrpt", *MAPPED) if name in rows}
    if "mrpt" in best:
        yield f"| MRPT insertObservation (log-odds), one core | {best['mrpt'] / 1e6:.2f} M rays/s | 1 |"
    for name, work in MAPPED.items():
        relative = f"{best[name] / best['mrpt']:.2f} x MRPT" if "mrpt" in best else "–"
        what = f"`{name}` ({work}) through the public mapper, one core"
        yield f"| {what} | {best[name] / 1e6:.2f} M rays/s | {relative} |"


def command_lines(rows: Rows) -> Iterator[str]:
    """Yield the rows of reading, recording, and whole commands."""
    middle = {name: statistics.median(values) for name, values in rows.items()}
    faster = median_ratio(rows["reading"], rows["reading by mcap"])
    yield f"| reading, decoded scans of 500 beams | {middle['reading']:,.0f} scans/s | {faster:.2f} x mcap's reader |"
    for motion in ("warp", "drive"):
        yield f"| recording, {motion} | {middle[f'recording {motion}']:.0f} x real time | – |"
    for name in REPLAYS:
        relative = median_ratio(rows[f"replay{name}"], rows["replay"])
        what = f"`prim-replay LOG{name}`, {middle['scans']:.0f} scans, with start-up"
        yield f"| {what} | {middle[f'replay{name}']:.2f} s | {relative:.2f} |"
    share = median_ratio(rows["help"], rows["numpy"])
    yield f"| `prim-replay --help` | {middle['help']:.2f} s | {share:.2f} x `import numpy` |"
    yield f"| viewer's share of `prim-replay LOG` | {middle['viewer']:.0%} | – |"
    for mapper in LOOK_MAPPERS:
        look, ratios = " ".join(ONE_LOOK), rows[f"looks {mapper}"]
        what = f"`prim-replay LOG --mapper {mapper}`, sessions of about 100 scans, beside the same with `{look}`"
        yield f"| {what} | – | {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}) |"


def memory_lines(rows: Rows) -> Iterator[str]:
    """Yield the rows of peak memory."""
    short, long = MINUTES
    for name in REPLAYS:
        first, second = (rows[f"memory {minutes}{name}"][0] for minutes in MINUTES)
        what = f"`prim-replay LOG{name}`, peak memory, {short} / {long} minutes of log"
        yield f"| {what} | {first:.0f} / {second:.0f} MiB | {second / first:.2f} |"


def median_ratio(values: list[float], references: list[float]) -> float:
    """Return the median of the ratios of values to references, round by round."""
    return statistics.median(a / b for a, b in zip(values, references, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--peers", type=Path, default=Path(__file__).parents[2] / "shared" / "peers")
    parser.add_argument("--update", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        rows = measure(options.rounds, options.peers, Path(scratch))
    content = table(rows)
    print(content)
    if options.update:
        update(options.update, "bench-speed", content)


if __name__ == "__main__":
    main()
