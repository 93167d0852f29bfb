"""The pages of results show what the benchmarks wrote, and README and the tutorial what the pages show."""

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))

import page  # noqa: E402


@pytest.mark.parametrize("path", page.PAGES, ids=lambda path: path.name)
def test_page_has_the_figures_of_the_records(path):
    shown = path.read_text(encoding="utf-8")
    assert "<!-- results:" in shown
    assert shown == page.filled(shown, page.Records()), "its figures are old: run `make results`"
