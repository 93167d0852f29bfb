"""`catstream loadtest`: a real run, its figures in three forms, and an exit code that says whether it held."""

import json
import re

import psutil
import pytest

from catstream.loadtest import load_report, load_test


def test_run_counts_every_frame_and_prints_the_violated_limit(said, tmp_path):
    arguments = ["--rate", 20, "--duration", 3, "--size", "320x240", "--subscribers", 3, "--slow-subscribers", 2]
    limits = ["--limit", "max=0", "--limit", "missed=1"]
    code, output, errors = said("loadtest", *arguments, *limits, "--output", "load", "--json", "x.json", cwd=tmp_path)
    assert code == 1
    broken = r"catstream: limit exceeded: max is .*, limit at most 0 ms \(from a frame to its track\)"
    assert re.fullmatch(broken, errors.splitlines()[-1])
    assert re.search(r"^0 +\d+\.\d +\d+\.\d %", output, re.MULTILINE)
    assert "met: missed" in output

    figures = json.loads((tmp_path / "x.json").read_text())
    (stream,) = figures["streams"]
    assert stream["frames"] == 60
    assert stream["frames_per_second"] == pytest.approx(20 * (1 - stream["skipped"]))
    assert stream["sent"] == stream["stored"] >= 60 * (1 - stream["skipped"])
    assert 0 < stream["track"]["p50"] <= stream["track"]["max"]
    assert 0 < stream["model"]["p50"] <= stream["model"]["max"]
    assert figures["subscribers"]["received"] != [0]
    assert {"detector 0", "compressor 0", "trainer 0", "camera", "subscribers"} <= set(figures["processes"])
    assert figures["processes"]["detector 0"]["cores"] > 0

    page = (tmp_path / "load" / "report.html").read_text()
    assert "<h2>Streams</h2>" in page
    assert not re.search(r"(src|href)=|<script|@import|url\(|nan", page)


@pytest.mark.system
def test_search_for_the_number_of_streams_names_it_first_and_what_each_costs(said, tmp_path, monkeypatch):
    for module in (load_test, load_report):
        monkeypatch.setattr(module, "MOST_STREAMS", 2)
    arguments = ["--find-streams", "--rate", 20, "--duration", 1, "--size", "320x240", "--limit", "p99=60"]
    code, output, _ = said("loadtest", *arguments, "--output", "load", "--json", "x.json", cwd=tmp_path)
    assert code == 0
    steps, _, rest = output.partition(
        "This machine serves at least 2 streams of 320x240 pixels, 20 frames/s due in each; "
    )
    assert re.findall(r"^(\d) streams?, .* cores, .* MB: met$", steps, re.MULTILINE) == ["1", "2"]
    assert re.match(r"a stream takes \d\.\d\d cores and \d+ MB\.\n", rest)

    figures = json.loads((tmp_path / "x.json").read_text())
    assert figures["highest_streams"] == 2
    for stream in figures["streams"]:
        assert 0 < stream["cores"] < psutil.cpu_count()
        assert 10e6 < stream["memory"] < 2e9
    page = (tmp_path / "load" / "report.html").read_text()
    places = [page.index(part) for part in ("This machine serves", "Steps of the search", "<h2>Streams</h2>")]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--size", "640"], "a size is WIDTHxHEIGHT"),
        (["--limit", "p98=1"], "a limit is NAME=VALUE with one of p50"),
        (["--output", "/dev/null/load"], "use another folder"),
        (["--set", "run.lockstep=true"], "omit run.lockstep"),
    ],
)
def test_contradictory_options_are_errors_before_the_start(fail, tmp_path, arguments, message):
    assert message in fail("loadtest", *arguments, cwd=tmp_path)
