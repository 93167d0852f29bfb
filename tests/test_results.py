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
FOUND = page.Records()
EVERY_RECORD = pytest.mark.parametrize("record", FOUND.values(), ids=FOUND.keys())


def measured_by(record: dict) -> str:
    """The benchmark, or the verb, that wrote a record."""
    program, name = record["command"].split()[:2]
    return name if program == "python" else f"{program} {name}"


@pytest.mark.parametrize("path", page.PAGES, ids=lambda path: path.name)
def test_a_page_has_the_figures_of_the_records(path):
    shown = path.read_text(encoding="utf-8")
    assert "<!-- results:" in shown
    assert shown == page.filled(shown, FOUND), "its figures are old: run `make results`"


def test_the_plots_of_the_results_are_those_of_the_records(monkeypatch, tmp_path):
    monkeypatch.setattr(page, "IMAGES", tmp_path)
    page.sequences(FOUND)
    page.long(FOUND)
    drawn = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert drawn == {name: (ROOT / "docs" / "images" / name).read_text() for name in drawn}
    assert len(drawn) == 2


def test_every_benchmark_has_a_record_and_every_record_its_place_on_a_page():
    measured = {measured_by(record) for record in FOUND.values()}
    assert measured == SCRIPTS | {"catstream evaluate", "catstream loadtest"}, (
        "benchmarks/results: see benchmarks/README.md"
    )
    read = page.Records()
    blocks = [block for path in page.PAGES for block in page.BLOCK.findall(path.read_text(encoding="utf-8"))]
    assert sorted(name for _, name, _ in blocks) == sorted(page.BLOCKS)
    for block in page.BLOCKS.values():
        block(read)
    assert read.read == read.keys(), "benchmarks/page.py does not show a record"


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
    assert "| the 20 on which the defaults were chosen |" in page.boxes(FOUND)


def test_every_sequence_of_the_benchmarks_has_the_attributes_that_need_looking():
    attributes = read_attributes(BENCHMARKS / "attributes.json")
    assert attributes.keys() == {row["name"] for row in FOUND["accuracy"]["sequences"]}
    assert all(attributes.values())
    known = {"deformation", "rotation", "occlusion", "blur", "clutter", "illumination"}
    assert {one for each in attributes.values() for one in each} == known
