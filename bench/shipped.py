"""The README's table of primitives, from the stored results of ``prim-eval --suite shipped``; measures nothing.

python -m bench.shipped [--update README.md]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.maps import update
from detect.evaluation.modes import RecordingMode
from detect.evaluation.suites import ShippedSuite
from detect.evaluation.tables import shipped_summary
from detect.networks.weights import SHIPPED
from prim.choices import MapperName

RESULTS = Path(__file__).parents[1] / "docs" / "shipped"
"""The folder of the stored results, as prim-eval takes it."""


def summary() -> str:
    """Return the table: warped sessions, maps of the forward mapper."""
    results = ShippedSuite(RESULTS, SHIPPED, print).results()
    return shipped_summary(results, RecordingMode.WARPED, MapperName.FORWARD)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--update", type=Path, help="the document that gets the table")
    options = parser.parse_args()
    print(summary())
    if options.update:
        update(options.update, "shipped", summary())
