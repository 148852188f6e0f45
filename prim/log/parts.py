"""A log in several files, one after the other: a ROS 2 bag that was split while it was recorded."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from prim.arrays import Stamps
from prim.errors import LogReadError
from prim.log.decoding.codecs import SCAN_CONTENTS
from prim.log.reader import LogReader
from prim.log.source import Message, Topic
from prim.log.time_resets import find_shifts, moved_behind_resets, reset_notes
from prim.text import MOST_LISTED, listed

METADATA = "metadata.yaml"
"""The file in a ROS 2 bag's folder that lists the others."""

COMPRESSED_SUFFIXES = (".zstd", ".zst", ".gz")
"""How the names of compressed files end."""

METADATA_BYTES = 4 << 20
"""METADATA is no longer (bytes): 300 for each file of a bag."""

YAML_BYTES = 1 << 14
"""So much of it is parsed as YAML at most (bytes), which takes 0.8 s; a plain list of files is read without."""

MAX_FILES = 10_000
"""A bag has no more files."""

STRING_TAG = "tag:yaml.org,2002:str"
"""What YAML calls text."""

MAX_NAME = 255
"""A file's name is no longer (bytes)."""

_PATHS = re.compile(r"^ *relative_file_paths:[ \t]*\n((?: *- [^\n]*(?:\n|\Z))+)", re.MULTILINE)
_PLAIN_NAME = re.compile(r""" *- (?:"([^"\\]*)"|'([^']*)'|(?=[\w.+ ()-]*[A-Za-z])(\w[\w.+ ()-]*+))[ \t]*""")
"""The list of files as rosbag2 writes it, and a file in it whose name needs no YAML to be read."""

_LOG_NAME = re.compile(r"\.(mcap|db3|bag|bag\.active)(\.(zstd|zst|gz))?$")
"""How the names of logs in a folder end."""


def files_of_bag(folder: Path) -> list[Path]:
    """Find the files of the bag in a folder, in the order in which they were recorded.

    Args:
        folder: The folder of a ROS 2 bag: with its ``metadata.yaml``, or with one log or the parts of one.

    Returns:
        The files; those that metadata.yaml lists may be missing.

    Raises:
        LogReadError: The folder holds no log, or several that do not belong together.
    """
    named = _distinct(_listed_files(folder))
    if any(file.exists() for file in named):
        return named
    by_stem = {_stem(path): path for path in sorted(folder.iterdir(), key=_preference, reverse=True) if _is_log(path)}
    found = _distinct(sorted(by_stem.values(), key=_part_number))
    if not found and named:
        return named
    if not found:
        raise LogReadError(folder, "a folder without a log in it", "give a log, or the folder of a ROS 2 bag")
    if len(found) > 1 and len({_part_number(path)[0] for path in found}) > 1:
        raise LogReadError(
            folder,
            f"a folder with {len(found)} logs ({listed(path.name for path in found)})",
            f"give one of them: {shlex.quote(str(found[0]))}",
        )
    return found


def notes_on_part(path: Path) -> list[str]:
    """Return what a user should know of a file that metadata.yaml lists as one of several of a bag.

    Args:
        path: The file.

    Returns:
        The notes.
    """
    try:
        names = [file.name for file in _listed_files(path.parent)]
    except LogReadError:  # of a list that this file does not need
        return []
    if len(names) < 2 or path.name not in names:
        return []
    which = (
        f"{path.name} is part {names.index(path.name) + 1} of {len(names)} of a bag, whose other parts are not read"
    )
    folder = shlex.quote(str(path.absolute().parent))
    return [f"{which} (static transforms, for one, may be in the first): for all give {folder}"]


def notes_on_unlisted(folder: Path, files: Sequence[Path]) -> list[str]:
    """Return what a user should know of parts of a bag in its folder that are not read.

    Args:
        folder: The folder.
        files: The files that are read.

    Returns:
        The notes.
    """
    read = {_stem(file) for file in files}
    bags = {_part_number(file)[0] for file in files}
    others = [path for path in folder.iterdir() if _is_log(path) and _stem(path) not in read]
    parts = [path for path in sorted(others, key=_part_number) if _part_number(path)[0] in bags]
    names = listed(path.name for path in parts)
    return [f"{METADATA} does not list {names}: not read; without {METADATA}, all are"] if parts else []


def _distinct(files: Sequence[Path]) -> list[Path]:
    """Return each file once, under the first of its names; those that are missing as they are."""
    known: dict[object, Path] = {}
    for file in files:
        try:
            found = file.stat()
            known.setdefault((found.st_dev, found.st_ino), file)
        except OSError:
            known.setdefault(file, file)
    return list(known.values())


def _listed_files(folder: Path) -> list[Path]:
    """Return the files that the folder's metadata.yaml lists, each once; none where it lists none.

    Raises:
        LogReadError: It is too large, or lists too many.
    """
    path = folder / METADATA
    try:
        if not path.is_file():
            return []
        if (size := path.stat().st_size) > METADATA_BYTES:
            raise LogReadError(path, f"a list of files of {size} bytes, more than {METADATA_BYTES}")
        names = _listed_names(path, path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return []  # without it, the files are found by their names
    if len(names) > MAX_FILES:
        raise LogReadError(path, f"a list of {len(names)} files, more than {MAX_FILES}")
    if not all(map(_is_file_name, names)):
        return []
    return list(dict.fromkeys(_present(folder / Path(name).name) for name in names))


def _listed_names(path: Path, text: str) -> list[str]:
    """Return the names of files in the text of metadata.yaml; none where it lists none, or is damaged.

    Raises:
        LogReadError: It is too large for what it is.
    """
    if plain := _PATHS.search(text):
        names = [_PLAIN_NAME.fullmatch(line) for line in plain[1].splitlines()]
        if all(names):
            return [next(part for part in name.groups() if part is not None) for name in names if name]
    if len(text) > YAML_BYTES:
        raise LogReadError(path, f"{len(text)} characters that are not what rosbag2 writes")
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:  # composed, not constructed: that takes exponentially long where there are aliases of aliases
        node: Any = YAML(typ="safe", pure=True).compose(text)
        for key in ("rosbag2_bagfile_information", "relative_file_paths"):
            node = {name.value: value for name, value in node.value if isinstance(name.value, str)}[key]
    except (YAMLError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return []
    if not isinstance(node.value, list) or not all(getattr(item, "tag", "") == STRING_TAG for item in node.value):
        return []
    return [str(item.value) for item in node.value]


def _is_file_name(name: str) -> bool:
    return Path(name).name not in ("", "..") and len(name.encode()) <= MAX_NAME and "\0" not in name


def _present(file: Path) -> Path:
    """Return a listed file under the name that it has: rosbag2 forgets or adds the suffix of its compression."""
    plain = file.with_suffix("") if file.suffix in COMPRESSED_SUFFIXES else file
    names = (file.name, plain.name, *(plain.name + suffix for suffix in COMPRESSED_SUFFIXES))
    return next((file.with_name(name) for name in names if file.with_name(name).exists()), file)


def _is_log(path: Path) -> bool:
    return path.is_file() and _LOG_NAME.search(path.name) is not None


def _preference(path: Path) -> tuple[bool, str]:
    """Return what sorts the log that is not compressed before the others of its name."""
    return path.suffix in COMPRESSED_SUFFIXES, path.name


def _stem(path: Path) -> str:
    return _LOG_NAME.sub("", path.name)


def _part_number(path: Path) -> tuple[str, int]:
    """Return what sorts the parts of a bag: bag_2 comes before bag_10, and what their names have in common.

    rosbag of ROS 1 puts the time at which a part was begun before its number.
    """
    number = re.search(r"_(\d+)$", _stem(path))
    if number is None:
        return _stem(path), -1
    return re.sub(r"\d{4}(-\d\d){5}$", "", _stem(path)[: number.start()]), int(number[1])


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
        self, path: Path, files: Sequence[Path], recover: bool, open_file: Callable[[Path], LogReader]
    ) -> None:
        super().__init__(path, recover)
        self._stack = ExitStack()
        self._parts: list[LogReader] = []
        self._missing: list[str] = []
        try:
            for file in files:
                self._open_part(file, open_file)
            if not self._parts:
                raise LogReadError(
                    path, f"none of its {len(files)} files can be read: {'; '.join(self._missing[:MOST_LISTED])}"
                )
        except BaseException:
            self.close()
            raise
        times = self._sort_parts()
        self.topics = self._merged_topics()
        self._shifts = find_shifts(np.concatenate(times))
        self.notes += [note for part in self._parts for note in part.notes]
        self.notes += reset_notes(self._shifts)
        self.metadata = {name: values for part in self._parts for name, values in part.metadata.items()}

    def _open_part(self, file: Path, open_file: Callable[[Path], LogReader]) -> None:
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
    def file_bytes(self) -> int:
        """See :attr:`prim.log.reader.LogReader.file_bytes`."""
        return sum(part.file_bytes for part in self._parts)

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
        messages = (message for part in self._parts for message in part.messages(*topics))
        return moved_behind_resets(messages, self._shifts) if len(self._shifts) > 1 else messages

    def _sort_parts(self) -> list[Stamps]:
        """Sort the parts by their times, where these do not overlap: metadata.yaml may list them in another order.

        Returns:
            When the scans of a topic were logged (ns), by parts.
        """
        topics = [topic for part in self._parts for topic in part.holding(*SCAN_CONTENTS)]
        times = [part.log_times(topics[0].name) if topics else np.zeros(0, np.int64) for part in self._parts]
        order = sorted((of_part.min(), of_part.max(), k) for k, of_part in enumerate(times) if len(of_part))
        positions = [k for _, _, k in order]
        if len(order) < len(times) or positions == sorted(positions):
            return times
        if any(part.notes for part in self._parts) or any(b[0] < a[1] for a, b in pairwise(order)):
            return times
        self._parts = [self._parts[k] for k in positions]
        names = listed(part.path.name for part in self._parts)
        self.notes = [f"the files of the bag are read in the order of their times: {names}"]
        return [times[k] for k in positions]
