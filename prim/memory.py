"""How much memory this machine has."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Where a container's limit is given, on Linux."""

UNKNOWN_MACHINE = 8_000_000_000
"""What a machine is taken to have that does not say (bytes)."""


def machine_memory() -> int:
    """Return the memory (bytes) of this machine, or of the container that this process runs in."""
    limits = []
    with suppress(ValueError, OSError, AttributeError):
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(ValueError, OSError):  # «max» is no number: no limit
        limits.append(int(CGROUP_LIMIT.read_text(encoding="ascii")))
    return min((limit for limit in limits if limit > 0), default=UNKNOWN_MACHINE)
