"""The entry points of prim-train and prim-eval, and of ``python -m detect``."""

from __future__ import annotations

from prim.interrupts import end_when_interrupted


def main() -> None:
    """Run prim-train."""
    end_when_interrupted("prim-train")
    from detect.cli import main as run

    run()


def main_eval() -> None:
    """Run prim-eval."""
    end_when_interrupted("prim-eval")
    from detect.cli import main_eval as run

    run()


if __name__ == "__main__":
    main()
