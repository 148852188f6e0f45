"""Automatic bounds of logs that hold no world: the map's area, and the range noise that the forward mapper finds.

    python -m bench.bounds [--sessions 10] [--first-seed 300] [--checkout DIR]

Sessions are recorded at several noise levels, every fifth without walls; their worlds and true primitives are left
out of a copy, which is replayed with automatic bounds, and once more with those that the world would give.
``--checkout`` replays the same logs by another checkout, for a comparison.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer

from prim.log.messages import TRUE_PRIMITIVES_TOPIC
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from recorder.world import WorldOptions
from replay.mapping.bounds import grid_frame_of_world

NOISE = (0.05, 0.1, 0.25, 0.5)
RESOLUTION = 0.01


def without_world(source: Path, target: Path) -> None:
    """Copy the messages of a log, but for the true primitives."""
    with source.open("rb") as read, target.open("wb") as write:
        writer = Writer(write)
        writer.start("ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(read).iter_messages():
            if schema is None or channel.topic == TRUE_PRIMITIVES_TOPIC:
                continue
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def replayed(checkout: Path, log: Path, *options: str) -> dict[str, Any]:
    """Return the part of the report that is about the map."""
    report = log.with_suffix(".json")
    command = [sys.executable, "-m", "replay", str(log), "--mapper", "forward", "--no-detect", "--no-viewer"]
    command += ["--quiet", "--force", "--report", str(report), *options]
    subprocess.run(command, cwd=checkout, check=True, capture_output=True)
    found: dict[str, Any] = json.loads(report.read_text(encoding="utf-8"))["map"]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=300)
    parser.add_argument("--checkout", type=Path, default=Path(__file__).parents[1])
    options = parser.parse_args()
    print("| noise, m | area over the world's | noise found, automatic bounds | noise found, the world's |")
    print("|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for noise in NOISE:
            areas, automatic, given = [], [], []
            for seed in range(options.first_seed, options.first_seed + options.sessions):
                whole, log = Path(folder) / "whole.mcap", Path(folder) / "log.mcap"
                walls = seed % 5 != 4
                session = SessionOptions(seed=seed, lidar=Lidar(noise_std=noise), world=WorldOptions(walls=walls))
                world = record_session(whole, session, force=True).world
                without_world(whole, log)
                found = replayed(options.checkout, log)
                bounds = grid_frame_of_world(world, RESOLUTION).bounds
                known = replayed(options.checkout, log, "--bounds", *(f"{side:g}" for side in bounds))
                areas.append(math.prod(found["cells"]) / math.prod(known["cells"]))
                automatic.append(found["noise_std_m"] / noise - 1)
                given.append(known["noise_std_m"] / noise - 1)
            means = (f"{statistics.fmean(shares):+.1%}" for shares in (automatic, given))
            print(f"| {noise} | {statistics.fmean(areas):.2f} | {' | '.join(means)} |", flush=True)


if __name__ == "__main__":
    main()
