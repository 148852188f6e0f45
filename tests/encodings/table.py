"""All encodings of a log that prim reads, each with the function that writes it and what it carries."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tests.encodings import carmen, foxglove, ros1, ros2
from tests.encodings.content import LogContent, by_topic, without_records

Reduction = Callable[[LogContent], LogContent]


class Encoding(NamedTuple):
    """A way to write a log.

    Attributes:
        name: For people.
        write: Writes the log into an empty folder, and returns what prim-replay is given.
        carried: Reduces a log to what this encoding carries.
        lossless: Whether it carries all messages whole; SQLite and bags lack attachments even so.
    """

    name: str
    write: Callable[[LogContent, Path], Path]
    carried: Reduction
    lossless: bool


def everything(content: LogContent) -> LogContent:
    """Return the log as it is."""
    return content


def _unsorted(write: Callable[[LogContent, Path], Path]) -> Callable[[LogContent, Path], Path]:
    """Make a writer put the messages into the file in another order than that of their times."""
    return lambda content, folder: write(by_topic(content), folder)


ENCODINGS = [
    *(
        Encoding(name, write, everything, True)
        for name, write in {
            "mcap": ros2.write_mcap,
            "mcap-lz4": ros2.write_mcap_lz4,
            "mcap-uncompressed": ros2.write_mcap_uncompressed,
            "mcap-unchunked": ros2.write_mcap_unchunked,
            "mcap-unindexed": ros2.write_mcap_unindexed,
            "mcap-unindexed-unchunked": ros2.write_mcap_unindexed_unchunked,
            "mcap-unsorted": _unsorted(ros2.write_mcap),
            "mcap-unsorted-unchunked": _unsorted(ros2.write_mcap_unchunked),
            "mcap-unsorted-unindexed": _unsorted(ros2.write_mcap_unindexed),
            "mcap-zstd-messages": ros2.write_mcap_zstd_messages,
            "mcap.zst": ros2.write_mcap_zst,
            "mcap.zstd": ros2.write_mcap_zstd,
            "mcap.gz": ros2.write_mcap_gz,
            "mcap-ros1": ros1.write_mcap,
        }.items()
    ),
    *(
        Encoding(name, write, without_records, True)
        for name, write in {
            "mcap-folder": ros2.write_mcap_folder,
            "mcap-folder-zstd-file": ros2.write_mcap_folder_zstd_file,
            "mcap-folder-zstd-messages": ros2.write_mcap_folder_zstd_messages,
            "mcap-split": ros2.write_mcap_split,
            "mcap-split-zstd-file": ros2.write_mcap_split_zstd_file,
            "db3": ros2.write_db3,
            "db3-foxy": ros2.write_db3_foxy,
            "db3-unsorted": _unsorted(ros2.write_db3_foxy),
            "db3.zstd": ros2.write_db3_zstd,
            "db3-zstd-messages": ros2.write_db3_zstd_messages,
            "db3-folder": ros2.write_db3_folder,
            "db3-folder-zstd-file": ros2.write_db3_folder_zstd_file,
            "db3-folder-zstd-messages": ros2.write_db3_folder_zstd_messages,
            "db3-split": ros2.write_db3_split,
            "db3-split-zstd-file": ros2.write_db3_split_zstd_file,
            "bag": ros1.write_bag,
            "bag-bz2": ros1.write_bag_bz2,
            "bag-lz4": ros1.write_bag_lz4,
            "bag-old-tf": ros1.write_bag_old_tf,
            "bag-unsorted": _unsorted(ros1.write_bag),
        }.items()
    ),
    Encoding("foxglove-protobuf", foxglove.write_protobuf, foxglove.reduce_to_protobuf, False),
    Encoding("foxglove-json", foxglove.write_json, foxglove.reduce_to_json, False),
    *(
        Encoding(name, write, carmen.reduce_to_carmen, False)
        for name, write in {
            "carmen-flaser": carmen.write_flaser,
            "carmen-flaser-gz": carmen.write_flaser_gz,
            "carmen-rlaser": carmen.write_rlaser,
            "carmen-robotlaser": carmen.write_robotlaser,
        }.items()
    ),
]
