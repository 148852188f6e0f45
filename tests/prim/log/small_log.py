"""A log of few and small messages, for tests of how it is stored."""

import math
from collections.abc import Callable, Iterable

import numpy as np

from prim.log import open_log
from prim.log.messages import ODOMETRY_TYPE, SCAN_TYPE, encode_odometry, encode_scan
from prim.log.source import Message
from prim.scan import Scan
from prim.se2 import Pose2D
from tests.encodings.content import LogContent

SECOND = 10**9
START = 1_700_000_000 * SECOND
BEAMS = 180

Clock = Callable[[int], int]


def small_log(scans: int = 60, clock: Clock = lambda time: time) -> LogContent:
    """Scans of 10 Hz and odometry of 20 Hz; ``clock`` makes stamps and log times of the times (ns) that pass."""
    messages = []
    for k in range(2 * scans):
        time = clock(START + k * SECOND // 20)
        messages.append(Message("/odom", time + 1, encode_odometry(time, Pose2D(k / 100, 0.0, 0.0))))
        if k % 2 == 0:
            ranges = np.random.default_rng(k).uniform(0.2, 4.0, BEAMS).astype(np.float32)
            scan = Scan(time, "laser", -math.pi, 2 * math.pi / BEAMS, 0.1, 5.0, ranges)
            messages.append(Message("/scan", time + 2, encode_scan(scan)))
    return LogContent({"/odom": ODOMETRY_TYPE, "/scan": SCAN_TYPE}, tuple(messages), {}, {})


def stored(path: object, recover: bool = False) -> tuple[list[Message], list[str], int | None]:
    """Read all messages of a log, what was lost, and how many messages that was."""
    with open_log(str(path), recover) as log:
        messages = list(log.messages(*log.topics))
        return messages, list(log.lost), log.messages_lost


def log_times(messages: Iterable[Message], topic: str = "/scan") -> list[int]:
    """Return when the messages of a topic were logged (ns)."""
    return [message.log_time for message in messages if message.topic == topic]


def set_back(time: int) -> int:
    """Return the time (ns) of a clock that was set back by 2 s when 4 s had passed."""
    return time if time < START + 4 * SECOND else time - 2 * SECOND
