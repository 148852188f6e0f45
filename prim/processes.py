"""Pools of processes, which end with the process that made them, however that ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait

from prim.threads import cores


@contextmanager
def process_pool(processes: int | None = None) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes for the time of a context.

    Where that ends by an exception, what is not begun is given up; where it is interrupted, what is running is not
    waited for. Ctrl-C reaches all processes of a terminal: it is for this one alone, since a worker that it ended may
    keep a lock for ever.

    Args:
        processes: How many; None: one for each core.

    Yields:
        The pool.
    """
    pool = ProcessPoolExecutor(processes or cores(), initializer=_begin_worker)
    try:
        yield pool
    except BaseException as error:
        pool.shutdown(wait=not isinstance(error, KeyboardInterrupt), cancel_futures=True)
        raise
    pool.shutdown()


def _begin_worker() -> None:
    """Let a worker end when its parent does, and by nothing that is meant for the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
