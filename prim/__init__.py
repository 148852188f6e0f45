"""The vocabulary that all parts of prim share: shapes, frames, worlds, metrics, logs."""

__version__ = "0.2.0"
