"""What counts as a finding: how a command that was given a damaged or hostile input may not behave."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

from bench.fuzzing.case import Case

RECOVER = "--recover"
LISTING = "--list"


@dataclass(frozen=True)
class Limits:
    """What a run may take, by the size N of its input.

    Attributes:
        seconds: CPU time (s).
        seconds_per_megabyte: For each MB of input (s).
        megabytes: Peak memory of the process (MB).
        megabytes_per_megabyte: For each MB of input (MB).
        patience: A run is ended when it has taken so much more CPU time (s): the first one may compile something.
        wall_seconds: A run that uses no CPU time is ended then (s).
    """

    seconds: float = 1.0
    seconds_per_megabyte: float = 2.0
    megabytes: float = 600.0
    megabytes_per_megabyte: float = 4.0
    patience: float = 10.0
    wall_seconds: float = 120.0

    def time(self, megabytes: float) -> float:
        """Return how much CPU time an input may take (s)."""
        return self.seconds + self.seconds_per_megabyte * megabytes

    def memory(self, megabytes: float) -> float:
        """Return how much memory an input may take (MB)."""
        return self.megabytes + self.megabytes_per_megabyte * megabytes


LIMITS = Limits()


@dataclass(frozen=True)
class Outcome:
    """What a run did.

    Attributes:
        options: The options that it had beside the case's own.
        ending: How it ended where it did not return an exit code: «no end», or a signal; else empty.
        code: The exit code.
        printed: What it printed on stdout.
        errors: What it printed on stderr.
        report: What is wrong with its report; empty where it is JSON, or where there is none.
        content: A digest of its map and trajectory, and of what its report says of the log, the poses and the map;
            empty where there is no report.
        seconds: Its CPU time (s).
        megabytes: The process' peak memory (MB) in this run; 0 where the system cannot say.
    """

    options: tuple[str, ...] = ()
    ending: str = ""
    code: int = 0
    printed: str = ""
    errors: str = ""
    report: str = ""
    content: str = ""
    seconds: float = 0.0
    megabytes: float = 0.0


def is_slow(case: Case, outcome: Outcome, limits: Limits) -> bool:
    """Return whether a run took more CPU time than it may.

    Args:
        case: What it was given.
        outcome: What it did.
        limits: What it may take.

    Returns:
        Whether it did.
    """
    return outcome.seconds > limits.time(case.megabytes)


def problem(case: Case, outcome: Outcome, whole: Container[str], limits: Limits) -> str:
    """Return what is wrong with a run.

    Args:
        case: What it was given.
        outcome: What it did.
        whole: The contents that the case's sample may have: it is read in another order to recover it.
        limits: What it may take.

    Returns:
        The finding; empty where there is none.
    """
    return (
        outcome.ending
        or _in_output(case, outcome)
        or outcome.report
        or _in_content(case, outcome, whole)
        or _in_effort(case, outcome, limits)
    )


def _in_output(case: Case, outcome: Outcome) -> str:
    text = outcome.printed + outcome.errors
    lines = [line for line in outcome.errors.split("\n") if line and not line.startswith("note: ")]
    if "Traceback (most recent call last)" in text or "this is a bug" in text:
        return "an unexpected exception"
    control = next((c for c in text if not c.isprintable() and c != "\n"), "")
    if control:
        return f"a raw control character is printed: {control!a}"
    if outcome.code not in (0, 1, 3) and not (case.may_refuse and outcome.code == 2):
        return f"exit code {outcome.code}"
    if len(lines) != (outcome.code in (1, 2)):
        return f"{len(lines)} error lines with exit code {outcome.code}"
    if "out of memory" in outcome.errors:
        return "out of memory"
    return ""


def _in_content(case: Case, outcome: Outcome, whole: Container[str]) -> str:
    if outcome.code == 0 and case.sample and outcome.content and outcome.content not in whole:
        return "exit code 0 with other content"
    if outcome.code == 1 and case.must_recover and RECOVER in outcome.options:
        return "all is lost to a small hole"
    return ""


def _in_effort(case: Case, outcome: Outcome, limits: Limits) -> str:
    seconds, megabytes = limits.time(case.megabytes), limits.memory(case.megabytes)
    if is_slow(case, outcome, limits):
        return f"it took {outcome.seconds:.1f} s of CPU time, more than {seconds:.1f}"
    if outcome.megabytes > megabytes:
        return f"it took {outcome.megabytes:.0f} MB of memory, more than {megabytes:.0f}"
    return ""
