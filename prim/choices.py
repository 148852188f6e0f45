"""What can be chosen by name, on the command lines and in options.

The standard library is all this module imports: a command line reads it before anything that takes time to load.
"""

from __future__ import annotations

from enum import StrEnum


class MapperName(StrEnum):
    """The mappers: deterministic, probabilistic, and the one with a forward sensor model."""

    DET = "det"
    PROB = "prob"
    FORWARD = "forward"


class SensorModelName(StrEnum):
    """The inverse sensor models of ``prob``."""

    EQ4 = "eq4"
    GAUSSIAN = "gaussian"


class ClockName(StrEnum):
    """The clocks that messages may be stamped by: their headers', the log's, or the headers' moved onto one clock."""

    AUTO = "auto"
    HEADER = "header"
    LOG = "log"


class SweepName(StrEnum):
    """What a scan's stamp may be the time of: its first beam or its last, of which the last may be measured first."""

    AUTO = "auto"
    START = "start"
    END = "end"
    START_REVERSED = "start-reversed"
    END_REVERSED = "end-reversed"


class PoseSourceName(StrEnum):
    """The sources of poses."""

    AUTO = "auto"
    TRUTH = "truth"
    TF = "tf"
    ODOM = "odom"
    FUSED = "fused"
    SCANS = "scans"


DEFAULT_SIZES = (0.05, 2.0)
"""The smallest and the largest object that is searched for (m), by its longest side or its diameter."""
