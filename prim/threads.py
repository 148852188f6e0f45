"""Threads: how many a process may use, and a pool of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Made = TypeVar("Made")


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def worker_pool(threads: int) -> Iterator[ThreadPoolExecutor | None]:
    """Yield a pool of threads for the time of a context; None where one thread is enough."""
    if threads == 1:
        yield None
        return
    with ThreadPoolExecutor(threads) as pool:
        yield pool


def preload(make: Callable[[], Made]) -> Future[Made]:
    """Make something in a thread of its own, such as what needs a slow import, while other work goes on.

    Args:
        make: Makes it.

    Returns:
        Its ``result()`` is what was made, or raises what went wrong.
    """
    pool = ThreadPoolExecutor(1)
    future = pool.submit(make)
    pool.shutdown(wait=False)
    return future
