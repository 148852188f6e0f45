"""The entry point of prim-replay, and of ``python -m replay``."""

from __future__ import annotations

from prim.interrupts import end_when_interrupted


def main() -> None:
    """Run prim-replay."""
    end_when_interrupted("prim-replay")
    from replay.cli import main as run

    run()


if __name__ == "__main__":
    main()
