"""Logs whose own times were set back while they were recorded, as with a simulation that was started anew."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np

from prim.arrays import Stamps
from prim.log.source import Message

MIN_RESET = 1_000_000_000
"""Times that go back by less (ns) are messages that were logged in another order; set by hand."""

MIN_RUN = 10
"""Fewer messages between two resets are a log that was written in another order; set by hand."""

GAP = 100_000_000
"""What comes after a reset is put so long (ns) behind what was before; set by hand."""


LATEST = 1 << 62
"""Times (ns) from here on are damage."""


def as_stamps(times: Iterable[int]) -> Stamps:
    """Return times (ns) as an array (N,); those that are beyond all times as LATEST."""
    return np.array([min(time, LATEST) for time in times], dtype=np.int64)


def find_shifts(log_times: Stamps) -> tuple[int, ...]:
    """Find out by how much log times are to be moved after each reset, so that they rise.

    Args:
        log_times: When the N messages of a topic were logged (ns), in the order in which they were written.

    Returns:
        What is to be added from the start on (0), and after each reset (ns).
    """
    resets = np.flatnonzero(np.diff(log_times) < -MIN_RESET) + 1
    runs = np.split(log_times, resets)
    if len(runs) == 1 or not all(len(run) >= MIN_RUN for run in runs):
        return (0,)
    if not all(_overlap(before, after) for before, after in pairwise(runs)):
        return (0,)
    shifts = [0]
    for before, after in pairwise(runs):
        shifts.append(shifts[-1] + int(before.max() - after[0]) + GAP)
    return tuple(shifts)


def _overlap(before: Stamps, after: Stamps) -> bool:
    """Return whether two runs of messages are of the same times; else they are one, written in another order."""
    return bool(after.max() > before.min() + MIN_RESET and after.min() < before.max() - MIN_RESET)


def reset_notes(shifts: Sequence[int]) -> list[str]:
    """Return what a user should know of resets, which :func:`find_shifts` found: nothing where there are none."""
    if len(shifts) == 1:
        return []
    times = f"{len(shifts) - 1} time{'s' * (len(shifts) > 2)}"
    return [
        f"the log's own times are set back {times}, by {shifts[-1] / 1e9:.1f} s in all: what follows is put behind "
        "what was before"
    ]


def moved_behind_resets(messages: Iterable[Message], shifts: Sequence[int]) -> Iterator[Message]:
    """Yield messages with log times that rise in spite of resets.

    Args:
        messages: The messages in the order in which they were written.
        shifts: As :func:`find_shifts` returns them.

    Yields:
        The messages; each topic's times are moved from where they go back.
    """
    last: dict[str, int] = {}
    resets: dict[str, int] = {}
    for topic, time, data in messages:
        if time < last.get(topic, time) - MIN_RESET:
            resets[topic] = min(resets.get(topic, 0) + 1, len(shifts) - 1)
        last[topic] = time
        yield Message(topic, time + shifts[resets.get(topic, 0)], data)
