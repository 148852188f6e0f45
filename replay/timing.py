"""Time in a replay: seconds spent in each stage, and pacing by the log's own clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

STAGES = ("read", "localize", "map", "detect", "refine", "viewer")
"""The stages that are timed."""

MAX_WAIT = 10.0
"""A paced replay waits no longer (s) for one scan, however long the log pauses; set by hand."""

StageProgress = Callable[[str, int, int], None]
"""Called with a stage, what of it is done, and what there is in all."""

Item = TypeVar("Item")


def no_stage_progress(stage: str, done: int, total: int) -> None:
    """Report nothing.

    Args:
        stage: The stage.
        done: What of it is done.
        total: What there is in all.
    """


class StageTimer:
    """Wall time spent in each stage (s).

    Time in a stage that is nested in another stage counts towards the inner one only, be it of another timer that
    shares the clock.

    Args:
        shared: A timer whose clock this one shares; None for a clock of its own, which starts now.

    Attributes:
        seconds: The time of each stage so far, by name (s).
    """

    def __init__(self, shared: StageTimer | None = None) -> None:
        self.seconds: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        self._start: float = shared._start if shared else time.perf_counter()
        self._nested: list[float] = shared._nested if shared else []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time of a ``with`` block towards the stage ``name``."""
        start = time.perf_counter()
        self._nested.append(0.0)
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[name] += elapsed - self._nested.pop()
            if self._nested:
                self._nested[-1] += elapsed

    def iterate(self, name: str, items: Iterable[Item]) -> Iterator[Item]:
        """Iterate while counting the time that it takes to produce each item.

        Args:
            name: The stage that the time counts towards.
            items: What to iterate over.

        Yields:
            The items.
        """
        source = iter(items)
        end = object()
        while True:
            with self.stage(name):
                item = next(source, end)
            if item is end:
                return
            yield item  # type: ignore[misc]

    def total(self) -> float:
        """Return the seconds since the clock started."""
        return time.perf_counter() - self._start


class RatePacer:
    """Holds a replay to a multiple of the log's own speed.

    Args:
        rate: How many times as fast as the log; None for no limit.
    """

    def __init__(self, rate: float | None) -> None:
        self._rate = rate
        self._start: tuple[float, int] | None = None

    def wait(self, stamp: int) -> None:
        """Sleep until a scan's ``stamp`` (ns) is due."""
        if self._rate is None:
            return
        if self._start is None:
            self._start = time.perf_counter(), stamp
        began, first = self._start
        ahead = (stamp - first) / 1e9 / self._rate - (time.perf_counter() - began)
        if ahead > MAX_WAIT:  # continue from here, or every scan after the pause would wait as well
            self._start = time.perf_counter() + MAX_WAIT, stamp
        if ahead > 0:
            time.sleep(min(ahead, MAX_WAIT))
