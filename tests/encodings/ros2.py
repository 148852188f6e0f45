"""ROS 2: MCAP in its variants, folders of bags, SQLite. Nothing is lost, but SQLite has no attachments."""

from __future__ import annotations

import gzip
import sqlite3
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from prim.log.messages import message_definition
from tests.encodings.content import LATCHED, LogContent, parts, without_records

CHUNK_BYTES = 16 * 1024
"""So small that a short log has several chunks."""
DATA_ALONE: dict[str, Any] = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}
"""Options of a writer that leaves the summary out."""
SPLITS = 3
MANY_SPLITS = 11
"""More than ten: the names of the parts are then not in the order of the parts."""

_ENDLESS = "{sec: 9223372036, nsec: 854775807}"
_LATCHED_QOS = f"""\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {_ENDLESS}
  lifespan: {_ENDLESS}
  liveliness: 1
  liveliness_lease_duration: {_ENDLESS}
  avoid_ros_namespace_conventions: false
"""


def mcap_bytes(content: LogContent, compress_messages: bool = False, **options: Any) -> bytes:
    """Return a log in MCAP.

    Args:
        content: The log.
        compress_messages: Whether each message is compressed by itself, as rosbag2's --compression-mode message does.
        **options: Of mcap's writer.

    Returns:
        The file.
    """
    stream = BytesIO()
    writer = Writer(stream, **{"chunk_size": CHUNK_BYTES} | options)
    writer.start(profile="ros2", library="test")
    channels = {}
    for topic, kind in content.types.items():
        schema = writer.register_schema(kind, "ros2msg", message_definition(kind).encode())
        qos = {"offered_qos_profiles": _LATCHED_QOS if topic in LATCHED else ""}
        channels[topic] = writer.register_channel(topic, "cdr", schema, qos)
    add_records(writer, content)
    for topic, log_time, data in content.messages:
        stored = zstandard.compress(data) if compress_messages else data
        writer.add_message(channels[topic], log_time, stored, log_time)
    writer.finish()
    return stream.getvalue()


def add_records(writer: Writer, content: LogContent) -> None:
    """Write the metadata and the attachments."""
    for name, values in content.metadata.items():
        writer.add_metadata(name, values)
    for name, data in content.attachments.items():
        writer.add_attachment(0, 0, name, "application/json", data)


def write_mcap(content: LogContent, folder: Path, **options: Any) -> Path:
    """Write a single MCAP file; ``options`` are those of :func:`mcap_bytes`."""
    return _written(folder / "log.mcap", mcap_bytes(content, **options))


def write_mcap_lz4(content: LogContent, folder: Path) -> Path:
    return write_mcap(content, folder, compression=CompressionType.LZ4)


def write_mcap_uncompressed(content: LogContent, folder: Path) -> Path:
    return write_mcap(content, folder, compression=CompressionType.NONE)


def write_mcap_unchunked(content: LogContent, folder: Path) -> Path:
    return write_mcap(content, folder, use_chunking=False)


def write_mcap_unindexed(content: LogContent, folder: Path) -> Path:
    return write_mcap(content, folder, **DATA_ALONE)


def write_mcap_unindexed_unchunked(content: LogContent, folder: Path) -> Path:
    return write_mcap(content, folder, use_chunking=False, **DATA_ALONE)


def write_mcap_zstd_messages(content: LogContent, folder: Path) -> Path:
    return write_mcap(content, folder, compress_messages=True, compression=CompressionType.NONE)


def write_mcap_zst(content: LogContent, folder: Path) -> Path:
    """As the command zstd does it of a stream: without the size of what was compressed."""
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    data = mcap_bytes(content, compression=CompressionType.NONE)
    return _written(folder / "log.mcap.zst", compressor.compress(data) + compressor.flush())


def write_mcap_zstd(content: LogContent, folder: Path) -> Path:
    """As rosbag2's --compression-mode file does it."""
    return _written(folder / "log.mcap.zstd", zstandard.compress(mcap_bytes(content)))


def write_mcap_gz(content: LogContent, folder: Path) -> Path:
    return _written(folder / "log.mcap.gz", gzip.compress(mcap_bytes(content)))


def write_bag(
    content: LogContent, folder: Path, plugin: StoragePlugin, mode: CompressionMode, version: Literal[8, 9] = 9
) -> Path:
    """Write a bag's folder by rosbags: metadata.yaml and one file.

    Args:
        content: The log.
        folder: Where the bag's folder is made.
        plugin: MCAP or SQLite.
        mode: What is compressed by zstd.
        version: Of rosbag2's metadata.

    Returns:
        The bag's folder.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    bag = BagWriter(folder / "bag", version=version, storage_plugin=plugin)
    bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        connections = {
            topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in content.types.items()
        }
        for topic, log_time, data in content.messages:
            bag.write(connections[topic], log_time, data)
    return folder / "bag"


def write_mcap_folder(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, StoragePlugin.MCAP, CompressionMode.NONE)


def write_mcap_folder_zstd_file(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, StoragePlugin.MCAP, CompressionMode.FILE)


def write_mcap_folder_zstd_messages(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, StoragePlugin.MCAP, CompressionMode.MESSAGE)


def write_db3_folder(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, StoragePlugin.SQLITE3, CompressionMode.NONE)


def write_db3_folder_zstd_file(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, StoragePlugin.SQLITE3, CompressionMode.FILE)


def write_db3_folder_zstd_messages(content: LogContent, folder: Path) -> Path:
    return write_bag(content, folder, StoragePlugin.SQLITE3, CompressionMode.MESSAGE, version=8)


def write_db3(content: LogContent, folder: Path) -> Path:
    """Write the file of a bag, as of ROS 2 Jazzy, without its metadata.yaml."""
    return _alone(write_db3_folder(content, folder))


def write_db3_zstd(content: LogContent, folder: Path) -> Path:
    return _alone(write_db3_folder_zstd_file(content, folder))


def write_db3_zstd_messages(content: LogContent, folder: Path) -> Path:
    return _alone(write_db3_folder_zstd_messages(content, folder))


def write_db3_foxy(content: LogContent, folder: Path) -> Path:
    """Write the two tables that ROS 2 Foxy wrote, without definitions of messages."""
    path = folder / "log.db3"
    base = sqlite3.connect(path)
    base.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
    )
    base.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
        " data BLOB NOT NULL)"
    )
    base.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    numbers = {topic: number for number, topic in enumerate(content.types, 1)}
    qos = {topic: _LATCHED_QOS if topic in LATCHED else "" for topic in content.types}
    rows = [(numbers[topic], topic, kind, "cdr", qos[topic]) for topic, kind in content.types.items()]
    base.executemany("INSERT INTO topics VALUES(?, ?, ?, ?, ?)", rows)
    messages = [(numbers[topic], log_time, data) for topic, log_time, data in content.messages]
    base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", messages)
    base.commit()
    base.close()
    return path


def write_mcap_split(content: LogContent, folder: Path) -> Path:
    return _write_split(content, folder, "mcap", SPLITS)


def write_mcap_split_zstd_file(content: LogContent, folder: Path) -> Path:
    return _write_split(content, folder, "mcap", SPLITS, ".zstd")


def write_db3_split(content: LogContent, folder: Path) -> Path:
    return _write_split(content, folder, "sqlite3", MANY_SPLITS)


def write_db3_split_zstd_file(content: LogContent, folder: Path) -> Path:
    return _write_split(content, folder, "sqlite3", SPLITS, ".zstd")


def _write_split(content: LogContent, folder: Path, storage: str, count: int, zstd: str = "") -> Path:
    """Write a bag's folder of several files, as ros2 bag record -d SECONDS does, with metadata.yaml."""
    bag = folder / "bag"
    bag.mkdir()
    suffix = ".mcap" if storage == "mcap" else ".db3"
    names = []
    for number, part in enumerate(parts(without_records(content), count)):
        path = (write_mcap if storage == "mcap" else write_db3_foxy)(part, folder)
        names.append(f"bag_{number}{suffix}{zstd}")
        data = path.read_bytes()
        path.unlink()
        (bag / names[-1]).write_bytes(zstandard.compress(data) if zstd else data)
    with (bag / "metadata.yaml").open("w", encoding="utf-8") as stream:
        YAML(typ="safe").dump(
            {"rosbag2_bagfile_information": _bag_information(content, names, storage, zstd)}, stream
        )
    return bag


def _bag_information(content: LogContent, names: list[str], storage: str, zstd: str) -> dict[str, Any]:
    """Return what metadata.yaml says, by version 5 of rosbag2's metadata (ROS 2 Humble)."""
    times = [message.log_time for message in content.messages]
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": _LATCHED_QOS if topic in LATCHED else "",
            },
            "message_count": len(content.of(topic)),
        }
        for topic, kind in content.types.items()
    ]
    return {
        "version": 5,
        "storage_identifier": storage,
        "relative_file_paths": names,
        "duration": {"nanoseconds": max(times) - min(times)},
        "starting_time": {"nanoseconds_since_epoch": min(times)},
        "message_count": len(times),
        "topics_with_message_count": topics,
        "compression_format": "zstd" if zstd else "",
        "compression_mode": "FILE" if zstd else "",
        "files": [],
    }


def _alone(bag: Path) -> Path:
    """Take the one file out of a bag's folder."""
    (file,) = (path for path in bag.iterdir() if path.name != "metadata.yaml")
    return file.rename(bag.parent / file.name)


def _written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path
