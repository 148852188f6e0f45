"""Names that a package exports and loads when they are first used, so that importing it takes no time."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_exports(
    package: str, exports: Mapping[str, str]
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Make what a package's ``__init__`` needs to load its exports when they are first used (PEP 562).

    Args:
        package: The package's name.
        exports: By exported name, the module that defines it.

    Returns:
        The package's ``__all__``, ``__getattr__`` and ``__dir__``.
    """

    def load(name: str) -> Any:
        if name not in exports:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(exports[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted(exports)

    return list(exports), load, names
