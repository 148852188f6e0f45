"""The entry point of prim-record, and of ``python -m recorder``."""

from __future__ import annotations

from prim.interrupts import end_when_interrupted


def main() -> None:
    """Run prim-record."""
    end_when_interrupted("prim-record")
    from recorder.cli import main as run

    run()


if __name__ == "__main__":
    main()
