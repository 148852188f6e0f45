"""Reading ROS 1's serialization: as CDR, little endian, but without alignment (wiki.ros.org/msg)."""

from __future__ import annotations

from prim.log.decoding.cdr import SECOND, CdrError, CdrReader


class Ros1Reader(CdrReader):
    """A cursor over one message of ROS 1.

    Args:
        data: The message.
    """

    __slots__ = ()

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._order = "<"
        self._at = 0

    def _aligned(self, size: int) -> int:
        return self._at

    def string(self) -> str:
        """Read a string, which has no closing NUL."""
        count = self.length(1)
        start, self._at = self._at, self._at + count
        try:
            return bytes(self._data[start : start + count]).decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"a string at byte {start} is not text: {error.reason}") from None

    def stamp(self) -> int:
        """Read a time (ns): unsigned seconds and nanoseconds."""
        seconds, nanoseconds = self.unpack("II", 4)
        return int(seconds) * SECOND + int(nanoseconds)

    def header_stamp(self) -> int:
        """Read the stamp (ns) of a std_msgs/Header, which follows a sequence number, and nothing behind it."""
        self.unpack("I", 4)
        return self.stamp()

    def header(self) -> tuple[int, str]:
        """Read a std_msgs/Header: stamp (ns) and frame."""
        return self.header_stamp(), self.string()
