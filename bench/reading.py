"""Reading decoded scans from each format, beside mcap's own reader, in turns; and the memory that each takes.

python -m bench.reading [--rounds 5] [--scans 4000] [--beams 500]
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import zstandard
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

from bench.speed import long_log, reading_rate, scans_by_mcap, scans_of
from prim.log import open_log
from prim.log.messages import ODOM_TOPIC, ODOMETRY_TYPE, SCAN_TOPIC, SCAN_TYPE
from prim.log.source import Message
from prim.scan import Scan

TYPES = {SCAN_TOPIC: SCAN_TYPE, ODOM_TOPIC: ODOMETRY_TYPE}


def messages_of(path: Path) -> Iterator[Message]:
    with open_log(path) as log:
        yield from log.messages(*TYPES)


def write_bag(source: Path, target: Path) -> None:
    """Write the messages as a ROS 1 bag."""
    store, old = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    with BagWriter(target) as bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=old) for topic, kind in TYPES.items()}
        for topic, log_time, data in messages_of(source):
            message = store.deserialize_cdr(data, TYPES[topic])
            message.header.seq = 0
            bag.write(connections[topic], log_time, old.serialize_ros1(message, TYPES[topic]))


def write_db3(source: Path, target: Path) -> None:
    """Write the messages as a ROS 2 bag in SQLite: a folder."""
    with Bag2Writer(target, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        store = get_typestore(Stores.ROS2_JAZZY)
        connections = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in TYPES.items()}
        for topic, log_time, data in messages_of(source):
            bag.write(connections[topic], log_time, data)


def write_ros1_mcap(source: Path, target: Path) -> None:
    """Write the messages in ROS 1's serialization to MCAP."""
    store, old = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
    with target.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels = {
            topic: writer.register_channel(topic, "ros1", writer.register_schema(kind, "ros1msg", b""))
            for topic, kind in TYPES.items()
        }
        for topic, log_time, data in messages_of(source):
            message = store.deserialize_cdr(data, TYPES[topic])
            message.header.seq = 0
            writer.add_message(channels[topic], log_time, bytes(old.serialize_ros1(message, TYPES[topic])), log_time)
        writer.finish()


def write_zst(source: Path, target: Path) -> None:
    """Write the log compressed as a whole."""
    target.write_bytes(zstandard.compress(source.read_bytes()))


FORMATS: dict[str, tuple[str, Callable[[Path, Path], None]]] = {
    "ROS 1 bag": ("log.bag", write_bag),
    "ROS 2 bag, SQLite": ("log.db3", write_db3),
    "MCAP, ROS 1 messages": ("ros1.mcap", write_ros1_mcap),
    "MCAP, zstd file": ("log.mcap.zst", write_zst),
}

MEMORY = """
import resource, sys
from pathlib import Path
from prim.log import open_log
with open_log(Path(sys.argv[1])) as log:
    for _ in log.decoded(log.topics["/scan"]):
        pass
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def memory(path: Path) -> float:
    """Return the peak memory (MB) of a process that reads a log."""
    run = subprocess.run([sys.executable, "-c", MEMORY, str(path)], capture_output=True, text=True, check=True)
    return int(run.stdout) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--scans", type=int, default=4000)
    parser.add_argument("--beams", type=int, default=500)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "log.mcap"
        long_log(source, options.scans, options.beams)
        paths = {"MCAP": source}
        for name, (file, write) in FORMATS.items():
            paths[name] = Path(folder) / file
            write(source, paths[name])
        rates: defaultdict[str, list[float]] = defaultdict(list)
        for _ in range(options.rounds):
            by_mcap: Iterator[Scan] = scans_by_mcap(source)
            rates["mcap's own reader"].append(reading_rate(by_mcap))
            for name, path in paths.items():
                rates[name].append(reading_rate(scans_of(path)))
        print(f"{options.scans} scans of {options.beams} beams, median of {options.rounds} rounds\n")
        print("| format | scans/s | over mcap's own reader | memory, MB |\n|---|---|---|---|")
        for name, values in rates.items():
            ratio = statistics.median(a / b for a, b in zip(values, rates["mcap's own reader"], strict=True))
            peak = f"{memory(paths[name]):.0f}" if name in paths else ""
            print(f"| {name} | {statistics.median(values):,.0f} | {ratio:.2f} | {peak} |")


if __name__ == "__main__":
    main()
