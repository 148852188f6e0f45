"""filterpy's Kalman filter, imported without all of scipy.stats.

``filterpy.kalman`` imports ``filterpy.stats``, whose likelihoods need scipy.stats: two thirds of the time that the
import takes. The tracker asks for no likelihood. While filterpy.kalman is imported, a module stands in for
``filterpy.stats`` that imports the real one when a likelihood is asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

NAME = "filterpy.stats"


@contextmanager
def _statistics_on_demand() -> Iterator[None]:
    """Let a module stand in for filterpy.stats, unless that is imported already."""
    if NAME in sys.modules:
        yield
        return
    stand_in = ModuleType(NAME)

    def logpdf(*arguments: Any, **keywords: Any) -> Any:
        from filterpy.stats import logpdf as likelihood

        return likelihood(*arguments, **keywords)

    stand_in.logpdf = logpdf  # type: ignore[attr-defined]
    sys.modules[NAME] = stand_in
    try:
        yield
    finally:
        del sys.modules[NAME]


with _statistics_on_demand():
    from filterpy.kalman import KalmanFilter

__all__ = ["KalmanFilter"]
