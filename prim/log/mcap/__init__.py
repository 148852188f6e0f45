"""MCAP logs (https://mcap.dev/spec): their records, a survey of where these lie, and reading them."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(__name__, {"McapReader": "prim.log.mcap.reader"})
