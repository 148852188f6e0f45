"""A log in several files, one after the other: a ROS 2 bag that was split while it was recorded."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from prim.errors import LogReadError
from prim.log.reader import LogReader
from prim.log.source import LogSource, Message, Topic

METADATA = "metadata.yaml"
"""The file in a ROS 2 bag's folder that lists the others."""

LOG_SUFFIXES = (".mcap", ".db3", ".bag")
"""How the names of logs in a folder end, whatever compression is named behind."""


def files_of_bag(folder: Path) -> list[Path]:
    """Find the files of the bag in a folder, in the order in which they were recorded.

    Args:
        folder: The folder of a ROS 2 bag: with its ``metadata.yaml``, or with one log or the parts of one.

    Returns:
        The files; those that metadata.yaml lists may be missing.

    Raises:
        LogReadError: The folder holds no log, or several that do not belong together.
    """
    listed = _listed_files(folder)
    if listed:
        return listed
    found = sorted((path for path in folder.iterdir() if _is_log(path)), key=_part_number)
    stems = {re.sub(r"_\d+$", "", _stem(path)) for path in found}
    if not found:
        raise LogReadError(folder, "a folder without a log in it", "give a log, or the folder of a ROS 2 bag")
    if len(found) > 1 and len(stems) > 1:
        names = ", ".join(path.name for path in found)
        raise LogReadError(folder, f"a folder with {len(found)} logs ({names})", f"give one of them: {found[0]}")
    return found


def bag_around(path: Path) -> list[Path]:
    """Return the files of the split bag that a file belongs to by its metadata.yaml; else the file alone."""
    try:
        listed = _listed_files(path.parent)
    except LogReadError:
        return [path]
    return listed if path.name in [other.name for other in listed] else [path]


def _listed_files(folder: Path) -> list[Path]:
    """Return the files that the folder's metadata.yaml lists; none without one. Raises LogReadError."""
    path = folder / METADATA
    if not path.is_file():
        return []
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        described: Any = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        names = described["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [folder / Path(str(name)).name for name in names]
    except (OSError, YAMLError, ValueError, KeyError, TypeError, RecursionError):
        return []  # without it, the files are found by their names
    return [_present(file) for file in files]


def _present(file: Path) -> Path:
    """Return a listed file under the name that it has: rosbag2 forgets or adds the suffix of its compression."""
    for name in (file.name, f"{file.name}.zstd", f"{file.name}.zst", file.name.removesuffix(".zstd")):
        if file.with_name(name).exists():
            return file.with_name(name)
    return file


def _is_log(path: Path) -> bool:
    return path.is_file() and any(f"{suffix}." in f"{path.name}." for suffix in LOG_SUFFIXES)


def _stem(path: Path) -> str:
    return re.sub(r"(\.mcap|\.db3|\.bag)(\..*)?$", "", path.name)


def _part_number(path: Path) -> tuple[str, int]:
    """Return what sorts the parts of a bag: bag_2 comes before bag_10."""
    number = re.search(r"_(\d+)$", _stem(path))
    return re.sub(r"_\d+$", "", _stem(path)), int(number[1]) if number else -1


class PartsReader(LogReader):
    """Several files that are one log: a :class:`prim.log.source.LogSource`. Transforms of one part hold in all.

    Args:
        path: The log as the user names it.
        files: Its files, in the order in which they were recorded.
        recover: Pass over files that are missing or cannot be read.
        open_file: Opens one of them.

    Raises:
        LogReadError: A file cannot be read, or with ``recover`` all of them.
    """

    def __init__(
        self, path: Path, files: Sequence[Path], recover: bool, open_file: Callable[[Path], LogSource]
    ) -> None:
        super().__init__(path, recover)
        self._stack = ExitStack()
        self._parts: list[LogSource] = []
        self._missing: list[str] = []
        try:
            for file in files:
                self._open_part(file, open_file)
            if not self._parts:
                raise LogReadError(path, f"none of its {len(files)} files can be read: {'; '.join(self._missing)}")
        except BaseException:
            self.close()
            raise
        self.topics = self._merged_topics()
        self.metadata = {name: values for part in self._parts for name, values in part.metadata.items()}

    def _open_part(self, file: Path, open_file: Callable[[Path], LogSource]) -> None:
        try:
            if not file.exists():
                raise LogReadError(file, f"a file of the bag {self.path} is missing", "read the rest with --recover")
            self._parts.append(self._stack.enter_context(open_file(file)))
        except LogReadError as error:
            if not self._recover:
                raise
            self._missing.append(f"{file.name}: {error.what}")

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    @property
    def format(self) -> str:
        """The log's format, for people."""
        return f"{self._parts[0].format} in {len(self._parts)} files"

    @property
    def lost(self) -> list[str]:
        """What could not be read so far, for people."""
        of_parts = (f"{part.path.name}: {lost}" for part in self._parts for lost in part.lost)
        return [*self._missing, *of_parts, *self._own_losses]

    @lost.setter
    def lost(self, losses: list[str]) -> None:
        self._own_losses = losses

    @property
    def messages_lost(self) -> int | None:
        """The number of messages that could not be read; None where the log does not say how many there were."""
        counts = [part.messages_lost for part in self._parts]
        known = [count for count in counts if count is not None]
        return None if self._missing or len(known) < len(counts) else sum(known) + len(self._undecodable)

    def _merged_topics(self) -> Mapping[str, Topic]:
        topics: dict[str, Topic] = {}
        counts: Counter[str] = Counter()
        for part in self._parts:
            for topic in part.topics.values():
                counts[topic.name] += topic.messages
                topics[topic.name] = topic._replace(messages=counts[topic.name])
        return topics

    def attachment(self, name: str) -> bytes | None:
        """See :meth:`prim.log.source.LogSource.attachment`."""
        return next((data for part in self._parts if (data := part.attachment(name)) is not None), None)

    def messages(self, *topics: str) -> Iterator[Message]:
        """See :meth:`prim.log.source.LogSource.messages`."""
        for part in self._parts:
            yield from part.messages(*topics)
