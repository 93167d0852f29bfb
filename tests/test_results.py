"""The pages of results show what the benchmarks wrote, and README and the tutorial what the pages show."""

import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))

import page  # noqa: E402

FOUND = page.Records()


@pytest.mark.parametrize("path", page.PAGES, ids=lambda path: path.name)
def test_a_page_has_the_figures_of_the_records(path):
    shown = path.read_text(encoding="utf-8")
    assert "<!-- results:" in shown
    assert shown == page.filled(shown, FOUND), "its figures are old: run `make results`"


def test_every_record_has_its_place_on_a_page():
    read = page.Records()
    for block in page.BLOCKS.values():
        block(read)
    assert read.read == read.keys(), "benchmarks/page.py does not show a record"
