"""One-pass evaluation: runs, their means, the report, and the command."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from catstream.base.settings import Settings
from catstream.errors import CatstreamError
from catstream.measure.accuracy import Row, write_report
from catstream.measure.datasets import Sequence
from catstream.measure.onepass import Run, evaluate

SETTINGS = Settings()


def test_several_processes_give_the_same_runs_as_one(sequence):
    longer = Sequence("longer", sequence.path, np.vstack([sequence.boxes, sequence.boxes[:1]]))  # than its frames
    late = Sequence("late", sequence.path, np.vstack([[[np.nan] * 4] * 2, sequence.boxes[2:]]))
    errors: list[CatstreamError] = []
    alone = evaluate([sequence, late], SETTINGS)
    pooled = evaluate([longer, sequence, late], SETTINGS, jobs=2, failed=errors.append)
    (error,) = errors
    assert re.match(r"longer: .* fewer frames than boxes", str(error))
    assert [run.sequence.name for run in pooled] == ["walk", "late"]
    for one, other in zip(alone, pooled, strict=True):
        np.testing.assert_array_equal(one.boxes, other.boxes)
    whole, part = alone
    assert (len(whole.boxes), len(part.boxes)) == (12, 10), "a run begins in the first frame with the object"
    np.testing.assert_allclose(part.boxes[0], sequence.boxes[2], atol=1e-3)
    assert whole.score().auc > 0.3
    assert (whole.seconds > 0).all()
    with pytest.raises(CatstreamError, match="longer: "):
        evaluate([longer], SETTINGS)


def test_equal_names_are_an_error(sequence):
    with pytest.raises(CatstreamError, match="duplicate sequence name 'walk'"):
        evaluate([sequence, sequence], SETTINGS)


def test_mean_averages_measures_and_adds_up_frames(sequence, found):
    boxes = found.copy()
    absent = np.flatnonzero(~sequence.present)
    boxes[[0, *absent[:2]]] = np.nan
    rows = [Row.of(Run(sequence, each, np.full(12, 0.01))) for each in (found, boxes)]
    mean = Row.mean(rows)
    assert mean.score.auc == pytest.approx(np.mean([row.score.auc for row in rows]))
    counts = (mean.frames, mean.score.absent, mean.score.noticed, mean.score.present, mean.score.false)
    assert counts == (24, 6, 2, 18, 1)
    assert mean.cells()[-3:-1] == ["2/6 33%", "1/18 5.6%"]


def test_report_is_self_contained(tmp_path, sequence, found):
    runs = [Run(replace(sequence, name="a & b"), found, np.full(12, 0.01))]
    errors = [CatstreamError("<b>")]
    page = write_report(tmp_path / "report.html", runs, Settings(coreset={"size": 32}), errors).read_text()
    assert page.count("<svg") == 2
    assert not re.search(r"(src|href)=\"(?!data:)|<script|@import|url\(", page)
    assert all(text in page for text in ("coreset.size=32", "a &amp; b", "Not included: &lt;b&gt;"))
    curves = [points.split() for points in re.findall(r'points="([^"]*)"', page)]
    assert [len(points) for points in curves] == [21, 51]
    assert [points[-1] for points in curves] == ["436.0,276.0", "436.0,36.0"]


def test_command_reports_all_sequences_if_some_failed(tmp_path, walk, said):
    for name in ("torn", "malformed", "walk"):
        shutil.copytree(walk, tmp_path / "all" / name)
    (tmp_path / "all" / "torn" / "img" / "0012.png").unlink()
    (tmp_path / "all" / "malformed" / "groundtruth_rect.txt").write_text("1,2,3,4\n")
    files = "--json", tmp_path / "out.json", "--report", tmp_path / "out.html"
    code, output, errors = said("evaluate", tmp_path / "all", *files, "--set", "coreset.size=32")
    assert re.search(r"walk +12 +0\.\d{3} .* \d/3 \d+(\.0)?% +0/9 0\.0%", output)
    page, figures = (tmp_path / "out.html").read_text(), json.loads((tmp_path / "out.json").read_text())
    for message in (r"torn: .* fewer frames than boxes", r"malformed/groundtruth_rect.txt\S* has one box"):
        assert re.search(message, errors)
        assert re.search(message, page)
    assert (code, "2 of 3 sequences failed" in errors.splitlines()[-1]) == (1, True)
    assert [row["name"] for row in figures["sequences"]] == ["walk"]
    assert figures["mean"]["success"] > 0.7
    assert figures["settings"] == ["coreset.size=32"]


@pytest.mark.parametrize("file", [("--json", "a/b"), ("--report", "video.mp4")])
def test_file_that_cannot_be_written_is_an_error_before_the_run(tmp_path, walk, fail, file):
    option, name = file
    (tmp_path / "video.mp4").write_bytes(b"a video")
    error = fail("evaluate", walk, option, tmp_path / name)
    assert re.search("existing folder|only a file whose name ends with .html", error)
