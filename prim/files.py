"""Files that prim writes: whole in their place or not there at all, and never over what is not prim's own."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from prim.errors import OutputError, UsageError

MAX_NAME_BYTES, KEPT_LETTERS = 255, 60
"""The longest name that file systems take, and how many letters of a longer one a file in the making keeps: each has
at most four bytes."""

MARKED_BYTES = 1 << 16
"""A result is recognised by so many bytes of its start or its end."""


@dataclass(frozen=True)
class ResultFormat:
    """A format of results: what an earlier one is recognised by, so that it may be replaced.

    Attributes:
        name: What it is called in messages, such as «a report».
        mark: Matches the start of such a file.
        at_end: Whether ``mark`` is searched in the file's end instead.
    """

    name: str
    mark: re.Pattern[bytes]
    at_end: bool = False

    def recognizes(self, path: Path) -> bool:
        """Return whether a file is such a result, or is empty. Raises OSError where it cannot be read."""
        with path.open("rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(0, size - MARKED_BYTES) if self.at_end else 0)
            content = stream.read(MARKED_BYTES)
        return not size or bool(self.mark.search(content) if self.at_end else self.mark.match(content))


def check_output(path: Path, result: ResultFormat, force: bool = False) -> bool:
    """Check that a file can be written and may be, before the work that would be lost.

    Args:
        path: The file.
        result: Its format.
        force: Whether a file may be replaced that is no earlier result.

    Returns:
        Whether an earlier file would be replaced.

    Raises:
        OutputError: It cannot be written: its folder is missing or may not be written to, or there is a folder, a
            device or a pipe in its place.
        UsageError: There is another file in its place, which only ``force`` replaces.
    """
    with output_errors(path):
        place = Path(os.path.realpath(path))
        if not place.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, f"there is no folder {path.parent}")
        if not os.access(place.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        try:
            mode = place.stat().st_mode
        except FileNotFoundError:
            return False
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "not a regular file")
        if not os.access(place, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        if not force and not result.recognizes(place):
            raise UsageError(f"{path} exists and is not {result.name}: give another name, or --force to replace it")
    return True


def check_no_input(inputs: Sequence[Path], outputs: Sequence[Path]) -> None:
    """Check that no output is an input under this or another name, by a link or of a folder's files.

    Args:
        inputs: Files that are read, and folders of ROS 2 bags.
        outputs: Files that would be written.

    Raises:
        UsageError: One is.
    """
    files = {found: name for name in inputs for path in _files_of(name) if (found := _identity(path))}
    for path in outputs:
        found = _identity(path)
        name = files.get(found) if found else None
        if name is not None:
            what = "is" if not name.is_dir() else "belongs to"
            raise UsageError(f"{path} {what} the input {name}: give the output another name")


def check_distinct(outputs: Sequence[Path]) -> None:
    """Check that no file would be written twice.

    Args:
        outputs: Files that would be written.

    Raises:
        UsageError: One would.
    """
    places = [os.path.realpath(path) for path in outputs]
    for path, place in zip(outputs, places, strict=True):
        if places.count(place) > 1:
            raise UsageError(f"{path} would be written twice: replay the logs one by one, each with names of its own")


def _files_of(path: Path) -> Iterator[Path]:
    """Yield a file itself; of the folder of a bag, the files that it consists of."""
    if path.is_dir():
        yield path / "metadata.yaml"
        for pattern in ("*.mcap*", "*.db3*", "*.onnx"):
            yield from path.glob(pattern)
    else:
        yield path


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what a file is known by under all of its names; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


class OutputFile:
    """A file in the making.

    Until it is complete, it lies beside its place under a name that nobody else uses, NAME.XXXXXXXX.part, where NAME
    is shortened if it has to be; then it is synced and renamed. A process that is killed leaves that file, and what
    was in its place before.

    Args:
        path: Its place; of a symbolic link, the file that it leads to.
        result: Its format.
        force: Whether a file in its place may be replaced that is no earlier result.

    Attributes:
        path: Its place, as it was given.
        part: Where it lies until it is complete.

    Raises:
        OutputError: It cannot be written, see :func:`check_output`.
        UsageError: There is another file in its place.
    """

    def __init__(self, path: Path, result: ResultFormat, force: bool = False) -> None:
        self.path = path
        self._result = result
        self._force = force
        check_output(path, result, force)
        self._place = Path(os.path.realpath(path))
        self.part = self._create()

    def _create(self) -> Path:
        """Create the file under a name that is free."""
        with output_errors(self.path):
            while True:
                ending = f".{secrets.token_hex(4)}.part"
                is_long = len(os.fsencode(self._place.name + ending)) > MAX_NAME_BYTES
                part = self._place.with_name(self._place.name[: KEPT_LETTERS if is_long else None] + ending)
                with suppress(FileExistsError):
                    os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666))
                    return part

    def commit(self) -> None:
        """Sync the complete file and put it in its place.

        Raises:
            OutputError: It cannot be written; what was in its place is still there.
            UsageError: Meanwhile there is another file in its place, which stays, and :attr:`part` as well.
        """
        try:
            replaces = check_output(self.path, self._result, self._force)
            with output_errors(self.path):
                if replaces:
                    shutil.copymode(self._place, self.part)
                _sync(self.part)
                self.part.replace(self._place)
        except UsageError as error:
            raise UsageError(f"{error}; what was written is in {self.part}") from error
        except BaseException:
            self.discard()
            raise
        with suppress(OSError):  # what follows is about a loss of power right now
            _sync(self._place.parent)

    def discard(self) -> None:
        """Remove the file; what was in its place stays."""
        with suppress(OSError):
            self.part.unlink(missing_ok=True)


def write_file(path: Path, content: bytes, result: ResultFormat, force: bool = False) -> None:
    """Write a file, whole or not at all.

    Args:
        path: The file.
        content: Its content.
        result: Its format.
        force: Whether a file in its place may be replaced that is no earlier result.

    Raises:
        OutputError: It cannot be written.
        UsageError: There is another file in its place.
    """
    write_files([(path, content, result)], force)


def write_files(files: Sequence[tuple[Path, bytes, ResultFormat]], force: bool = False) -> None:
    """Write files that belong together: none is put in its place before all are complete.

    Args:
        files: Of each one its path, its content and its format.
        force: Whether files in their places may be replaced that are no earlier results.

    Raises:
        OutputError: One cannot be written.
        UsageError: There is another file in the place of one.
    """
    complete: list[OutputFile] = []
    try:
        for path, content, result in files:
            complete.append(OutputFile(path, result, force))
            with output_errors(path):
                complete[-1].part.write_bytes(content)
    except BaseException:
        for file in complete:
            file.discard()
        raise
    for file in complete:
        file.commit()


@contextmanager
def output_errors(path: Path) -> Iterator[None]:
    """Turn what the system says of a file that cannot be written into an OutputError that names ``path``."""
    try:
        yield
    except OSError as error:
        raise OutputError(path, error) from error


def _sync(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on the disk."""
    if path.is_dir() and os.name != "posix":
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
