"""Logs whose own times were set back while they were recorded, as with a simulation that was started anew."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from prim.arrays import Stamps
from prim.log.source import Message

MIN_RESET = 1_000_000_000
"""Times that go back by less (ns) are messages that were logged in another order; set by hand."""

GAP = 100_000_000
"""What comes after a reset is put so long (ns) behind what was before; set by hand."""


def find_shifts(log_times: Stamps) -> tuple[int, ...]:
    """Find out by how much log times are to be moved after each reset, so that they rise.

    Args:
        log_times: When the N messages of a topic were logged (ns), in the order in which they were written.

    Returns:
        What is to be added from the start on (0), and after each reset (ns).
    """
    shifts = [0]
    if not (log_times < np.maximum.accumulate(log_times) - MIN_RESET).any():
        return (0,)
    latest: int | None = None
    for time in log_times.tolist():
        if latest is not None and time < latest - MIN_RESET:
            shifts.append(shifts[-1] + latest - time + GAP)
            latest = time
        latest = time if latest is None else max(latest, time)
    return tuple(shifts)


def moved_behind_resets(messages: Iterable[Message], shifts: Sequence[int]) -> Iterator[Message]:
    """Yield messages with log times that rise in spite of resets.

    Args:
        messages: The messages in the order in which they were written.
        shifts: As :func:`find_shifts` returns them.

    Yields:
        The messages; each topic's times are moved from where they go back.
    """
    latest: dict[str, int] = {}
    resets: dict[str, int] = {}
    for topic, time, data in messages:
        if time < latest.get(topic, time) - MIN_RESET:
            resets[topic] = min(resets.get(topic, 0) + 1, len(shifts) - 1)
            latest[topic] = time
        latest[topic] = max(latest.get(topic, time), time)
        yield Message(topic, time + shifts[resets.get(topic, 0)], data)
