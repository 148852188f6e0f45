"""Reading CDR, the serialization of ROS 2 messages (OMG DDS-XTypes, plain CDR version 1)."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

SECOND = 1_000_000_000
"""Nanoseconds."""


MAX_ITEMS = 100_000
"""A message has no more transforms or fields; an item takes up to 8 times as much memory as bytes; set by hand."""


class CdrError(ValueError):
    """Bytes that are not the expected message."""


class CdrReader:
    """A cursor over one message: reads its fields in their order, in either byte order, and respects alignment.

    Args:
        data: The message, its encapsulation header included.

    Raises:
        CdrError: The header is not plain CDR's; or, from any method, the message ends before the field does.
    """

    __slots__ = ("_at", "_data", "_order")

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise CdrError("not plain CDR: its encapsulation header is " + (bytes(data[:4]).hex(" ") or "missing"))
        self._data = data
        self._order = "<" if data[1] else ">"
        self._at = 4

    def unpack(self, form: str, size: int) -> tuple[float, ...]:
        """Read primitive fields of one size.

        Args:
            form: Their types, by the letters of the module struct.
            size: Their size, which is also their alignment (bytes, counted from behind the encapsulation header).

        Returns:
            The values.
        """
        at = self._aligned(size)
        try:
            values = struct.unpack_from(self._order + form, self._data, at)
        except struct.error:
            raise CdrError(f"it ends at byte {len(self._data)}, within its fields at byte {at}") from None
        self._at = at + size * len(values)
        return values

    def _aligned(self, size: int) -> int:
        """Return where the next field of ``size`` bytes begins."""
        return self._at + (4 - self._at) % size

    def length(self, item_size: int) -> int:
        """Read the length of a string or sequence of items of ``item_size`` bytes; it must fit into the message."""
        count = int(self.unpack("I", 4)[0])
        if count * item_size > len(self._data) - self._at:
            raise CdrError(f"it claims {count} items at byte {self._at} of {len(self._data)}")
        return count

    def items(self, limit: int = MAX_ITEMS) -> Iterator[int]:
        """Read the length of a sequence of messages, and iterate over their numbers.

        Args:
            limit: So many are allowed.

        Yields:
            The numbers.

        Raises:
            CdrError: It claims more, or more than there are bytes.
        """
        count = self.length(1)
        if count > limit:
            raise CdrError(f"it claims {count} items, more than {limit}")
        yield from range(count)

    def string(self) -> str:
        """Read a string, without its closing NUL."""
        count = self.length(1)
        start, self._at = self._at, self._at + count
        try:
            return bytes(self._data[start : start + max(count - 1, 0)]).decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"a string at byte {start} is not text: {error.reason}") from None

    def floats(self) -> NDArray[np.float32]:
        """Read a sequence of float32 into an array of its own."""
        count = self.length(4)
        start, self._at = self._at, self._at + 4 * count
        return np.frombuffer(self._data, self._order + "f4", count, start).astype(np.float32)

    def skip(self, item_size: int, alignment: int) -> None:
        """Skip a sequence of items of one size.

        Args:
            item_size: Bytes an item.
            alignment: Of the first item (bytes).
        """
        count = self.length(item_size)
        if count:
            self._at = self._aligned(alignment) + count * item_size

    def octets(self) -> bytes:
        """Read a sequence of bytes."""
        count = self.length(1)
        start, self._at = self._at, self._at + count
        return self._data[start : start + count]

    def stamp(self) -> int:
        """Read a builtin_interfaces/Time (ns)."""
        seconds, nanoseconds = self.unpack("iI", 4)
        return int(seconds) * SECOND + int(nanoseconds)

    def header_stamp(self) -> int:
        """Read the stamp (ns) of a std_msgs/Header, and nothing behind it."""
        return self.stamp()

    def header(self) -> tuple[int, str]:
        """Read a std_msgs/Header: stamp (ns) and frame."""
        return self.stamp(), self.string()
