"""The tables of the shipped weights are those of the stored results."""

from __future__ import annotations

from pathlib import Path

from bench.shipped import RESULTS, summary
from detect.evaluation.suites import ShippedSuite
from detect.evaluation.tables import write_shipped_report
from detect.networks.weights import SHIPPED

README = Path(__file__).parents[2] / "README.md"


def test_the_readmes_table_is_that_of_the_stored_results() -> None:
    """Else `python -m bench.shipped --update README.md` is due."""
    assert f"<!-- shipped -->\n{summary()}\n<!-- /shipped -->" in README.read_text(encoding="utf-8")


def test_the_report_is_that_of_the_stored_results(tmp_path: Path) -> None:
    """Else `prim-eval docs/shipped --suite shipped --so-far --output docs/shipped` is due."""
    for made in write_shipped_report(ShippedSuite(RESULTS, SHIPPED, print).results(), tmp_path):
        assert made.read_text(encoding="utf-8") == (RESULTS / made.name).read_text(encoding="utf-8")
