"""Small intact logs in every format and encoding that is read: what damage is done to."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from bench.fuzzing import mcap_file
from prim.log.writer import LogWriter
from recorder.sensors import Lidar
from recorder.session import SessionOptions, record_session
from recorder.world import WorldOptions
from tests.encodings.content import LogContent, delayed, read_content
from tests.encodings.ros2 import mcap_bytes
from tests.encodings.table import ENCODINGS

SECONDS, RAYS = 1.2, 25
"""Of the session that all samples hold: 12 scans of a scanner that CARMEN knows, too."""
FLUSHED = 8
"""Messages of a chunk of the killed recording."""

UNCHECKED = ("unchunked", "no-crc", "carmen", "db3", "bag", "mcap-folder")
"""Parts of names of samples whose messages have no checksum."""
CHECKED = ("carmen-flaser-gz", "bag-bz2")
"""Those that have one even so."""
PART = "part"
"""The killed recording: it is read with ``--recover`` alone."""


class Sample(NamedTuple):
    """An intact log.

    Attributes:
        name: Its encoding.
        files: Its files by their paths; those of a folder begin with its name.
        is_checked: Whether its messages have checksums, so that no damage of them goes unseen.
        is_counted: Whether it says how long it is or how much it holds, so that no cut goes unseen.
    """

    name: str
    files: Mapping[str, bytes]
    is_checked: bool
    is_counted: bool

    @property
    def is_mcap(self) -> bool:
        """Whether it is a single MCAP file that is not compressed as a whole."""
        return len(self.files) == 1 and next(iter(self.files.values())).startswith(mcap_file.MAGIC)

    @property
    def data(self) -> bytes:
        """Its first file, which is the only one but of bags in folders."""
        return next(iter(self.files.values()))


class Samples(NamedTuple):
    """All samples, and what they hold.

    Attributes:
        content: What all of them hold.
        by_name: The samples.
    """

    content: LogContent
    by_name: Mapping[str, Sample]

    def indexed_mcaps(self) -> list[Sample]:
        """Return the MCAP files that have a summary."""
        return [s for s in self.by_name.values() if s.is_mcap and "unindexed" not in s.name and s.name != PART]

    def mcaps(self) -> list[Sample]:
        """Return the MCAP files that are not compressed as a whole."""
        return [sample for sample in self.by_name.values() if sample.is_mcap and sample.name != PART]

    def bags(self) -> list[Sample]:
        """Return the ROS 1 bags."""
        return [sample for sample in self.by_name.values() if sample.data.startswith(b"#ROSBAG")]


def make_samples(seed: int = 0) -> Samples:
    """Record a short session and write it in every encoding.

    Args:
        seed: Of the session.

    Returns:
        The samples.
    """
    with TemporaryDirectory(prefix="prim-fuzz-") as folder:
        place = Path(folder)
        lidar = Lidar(rays=RAYS, fov=math.pi, range_min=0.15, range_max=1.2)
        world = WorldOptions(clutter=(2, 2))
        options = SessionOptions(seed=seed, motion="drive", duration=SECONDS, lidar=lidar, world=world)
        recorded = record_session(place / "recorded.mcap", options).path
        content = delayed(read_content(recorded))
        found = {"recorded": {"recorded.mcap": recorded.read_bytes()}}
        for encoding in ENCODINGS:
            (place / encoding.name).mkdir()
            found[encoding.name] = _files(encoding.write(content, place / encoding.name))
        found |= {name: {"log.mcap": data} for name, data in _further_mcaps(content).items()}
        found[PART] = {"log.mcap.part": _killed_recording(content, place / "killed.mcap")}
    samples = {
        name: Sample(name, files, _is_checked(name), not _is_plain_text(name)) for name, files in found.items()
    }
    return Samples(content, samples)


def _further_mcaps(content: LogContent) -> dict[str, bytes]:
    return {
        "mcap-small-chunks": mcap_bytes(content, chunk_size=1024),
        "mcap-data-crc": mcap_bytes(content, chunk_size=4096, enable_data_crcs=True),
        "mcap-no-crc": mcap_bytes(content, chunk_size=4096, enable_crcs=False),
    }


def _killed_recording(content: LogContent, path: Path) -> bytes:
    """Return what a recorder leaves that is killed: all up to the end of the last chunk."""
    with LogWriter(path) as log:
        for name, values in content.metadata.items():
            log.add_metadata(name, values)
        for name, data in content.attachments.items():
            log.add_attachment(name, "application/json", data, 0)
        for topic, kind in content.types.items():
            log.add_topic(topic, kind)
        for number, message in enumerate(content.messages, 1):
            log.write(message.topic, message.log_time, message.data)
            if number % FLUSHED == 0:
                log.flush()
    whole = path.read_bytes()
    data = mcap_file.take_apart(whole).data
    return data[: -(mcap_file.PREFIX.size + mcap_file.CRC_BYTES)]  # without the record that ends the data


def _files(log: Path) -> dict[str, bytes]:
    """Return a log's files, by their paths beside it."""
    files = sorted(log.rglob("*")) if log.is_dir() else [log]
    return {path.relative_to(log.parent).as_posix(): _timeless(path) for path in files if path.is_file()}


def _timeless(path: Path) -> bytes:
    """Return a file's bytes; those of gzip without the time when they were compressed (RFC 1952)."""
    data = path.read_bytes()
    return data[:4] + bytes(4) + data[8:] if data.startswith(b"\x1f\x8b") else data


def _is_checked(name: str) -> bool:
    return name in CHECKED or not any(part in name for part in UNCHECKED)


def _is_plain_text(name: str) -> bool:
    return name.startswith("carmen") and not name.endswith("gz")
