"""The pages of results show what the benchmarks wrote, and README and the tutorial what the pages show."""

import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"
sys.path.append(str(BENCHMARKS))

import page  # noqa: E402
from sequences import CHECK, TUNED  # noqa: E402

from catstream.evaluation.datasets import read_attributes  # noqa: E402

SCRIPTS = {path.relative_to(ROOT).as_posix() for path in BENCHMARKS.rglob("*.py") if "__main__" in path.read_text()}
SCRIPTS -= {"benchmarks/page.py"}  # it writes the pages
FOUND = page.records()
EVERY_RECORD = pytest.mark.parametrize("record", FOUND.values(), ids=FOUND.keys())


def measured_by(record: page.Record) -> str:
    """The benchmark, or the verb, that wrote a record."""
    program, name = record["command"].split()[:2]
    return name if program == "python" else f"{program} {name}"


@pytest.mark.parametrize("one", page.PAGES, ids=lambda one: one.path.name)
def test_a_page_is_the_one_that_the_records_give(one):
    shown = one.path.read_text(encoding="utf-8")
    assert shown == page.written(one, FOUND) == page.written(one, page.records()), "it is old: run `make results`"
    assert shown.count("\n") <= 200


def test_the_tables_of_the_results_name_their_measure_and_number_of_runs():
    assert all(part.measure for section in page.PAGES[0].sections for part in section.parts)


@pytest.mark.parametrize("path", page.MARKED, ids=lambda path: path.name)
def test_a_page_with_marks_has_the_figures_of_the_records(path):
    shown = path.read_text(encoding="utf-8")
    assert "<!-- results:" in shown
    assert shown == page.with_figures(path, FOUND), "its figures are old: run `make results`"


def test_every_benchmark_has_a_record_and_every_record_its_place_on_a_page():
    measured = {measured_by(record) for record in FOUND.values()}
    assert measured == SCRIPTS | {"catstream evaluate", "catstream loadtest"}, (
        "benchmarks/results: see benchmarks/README.md"
    )
    assert FOUND.keys() == page.shown(), "benchmarks/page.py does not show a record, or shows one that is not there"


@EVERY_RECORD
def test_a_record_has_its_provenance_and_no_folder_of_the_machine(record):
    assert {"version", "commit", "date", "command", "settings", "machine"} <= record.keys()
    assert re.fullmatch(r"[0-9a-f]{10}", record["commit"]), "measured beside changes that were not committed"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", record["date"])
    assert "--quick" not in record["command"], "the figures of --quick mean nothing"
    assert {"processor", "cores"} <= record["machine"].keys()
    assert not re.findall(r'"[^"]*(?:^|[ "=])/\w[^"]*"', json.dumps(record)), "a path of the machine"


def test_the_tuning_set_is_reported_separately():
    names = {row["name"] for row in FOUND["accuracy"]["sequences"]}
    assert (len(TUNED), len(CHECK), len(TUNED & CHECK)) == (20, 15, 3)
    assert names >= TUNED | CHECK
    assert "The defaults were chosen on the first 20" in page.written(page.PAGES[0], FOUND)


def test_every_sequence_of_the_benchmarks_has_the_attributes_that_need_looking():
    attributes = read_attributes(BENCHMARKS / "attributes.json")
    assert attributes.keys() == {row["name"] for row in FOUND["accuracy"]["sequences"]}
    assert all(attributes.values())
    known = {"deformation", "rotation", "occlusion", "blur", "clutter", "illumination"}
    assert {one for each in attributes.values() for one in each} == known
