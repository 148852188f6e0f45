"""A case of the fuzzer: the files that a command is given, and what must hold of what it does."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.fuzzing.samples import Samples

MEGABYTE = 1e6
"""Bytes."""


@dataclass(frozen=True)
class Case:
    """One input.

    Attributes:
        what: What was done to it, for people.
        files: Its files by their paths in the case's folder. The first one is the log, or lies in the log's folder.
        sample: The intact log with which an exit code 0 must agree in content; empty: any content will do.
        options: Further options of the command.
        must_recover: Whether ``--recover`` must find something: what is damaged is a small part.
        may_refuse: Whether exit code 2 is allowed: of files that an option names.
    """

    what: str
    files: Mapping[str, bytes]
    sample: str = ""
    options: tuple[str, ...] = ()
    must_recover: bool = False
    may_refuse: bool = False

    @property
    def log(self) -> str:
        """The path of the log in the case's folder."""
        return next(iter(self.files)).split("/")[0]

    @property
    def megabytes(self) -> float:
        """The size of all its files (MB)."""
        return sum(map(len, self.files.values())) / MEGABYTE


Generator = Callable[[random.Random, "Samples"], Case]
"""Makes a case of a kind: all randomness is the given one."""
