"""filterpy's Kalman filter, imported without what takes most of the time and the tracker does not use.

``filterpy.kalman`` imports ``filterpy.stats``, whose likelihoods need scipy.stats, and ``filterpy.discrete_bayes``,
which needs scipy.ndimage: three quarters of the time of the import. Meanwhile modules stand in for these two, which
import the real ones when something of them is asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


class _OnDemand(ModuleType):
    """A module that is imported when something of it is asked for; until then it stands in for it."""

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("__") or sys.modules.get(self.__name__) is self:
            raise AttributeError(f"module {self.__name__!r} has no attribute {attribute!r}")
        return getattr(__import__(self.__name__, fromlist=[attribute]), attribute)

    def logpdf(self, *arguments: Any, **keywords: Any) -> Any:
        """See filterpy.stats.logpdf, which filterpy.kalman names when it is imported."""
        return self.__getattr__("logpdf")(*arguments, **keywords)


@contextmanager
def _on_demand(*names: str) -> Iterator[None]:
    """Let modules be imported on demand by what is imported in a ``with`` block, unless they are imported already."""
    modules = {name: _OnDemand(name) for name in names if name not in sys.modules}
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name in modules:
            del sys.modules[name]


with _on_demand("filterpy.stats", "filterpy.discrete_bayes"):
    from filterpy.kalman import KalmanFilter

__all__ = ["KalmanFilter"]
