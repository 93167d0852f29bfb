"""`catstream loadtest`: a real run, its figures in three forms, and its exit status."""

import json
import re

import pytest


def test_load_test_counts_frames_and_prints_violated_limits(said, succeed, tmp_path):
    arguments = ["--rate", 20, "--duration", 3, "--size", "320x240", "--subscribers", 3, "--slow-subscribers", 2]
    limits = ["--limit", "max=0", "--limit", "subscriber-missed=1"]
    code, output, _ = said(
        "loadtest", *arguments, *limits, "--report", "load.html", "--json", "x.json", "--raw", "x.csv", cwd=tmp_path
    )
    assert code == 1
    assert re.search(r"^not met: max is .*, limit at most 0 ms \(from a frame to its track\)$", output, re.MULTILINE)
    last = "Not sustained (max): 1 stream of 320x240 pixels (mjpeg), 20 frames/s due in each, 3 subscribers to each."
    assert output.splitlines()[-1] == last
    assert re.search(r"^0 +\d+\.\d +\d+\.\d %", output, re.MULTILINE)
    assert "\nmet: subscriber-missed" in output

    figures = json.loads((tmp_path / "x.json").read_text())
    assert (figures["sustained"], figures["verdict"]) == (False, output.splitlines()[-1])
    assert figures["command"].startswith("catstream loadtest --rate 20")
    (stream,) = figures["streams"]
    assert stream["frames"] == 60
    assert stream["frames_per_second"] == pytest.approx(20 * (1 - stream["skipped"]))
    assert stream["sent"] == stream["stored"] >= 60 * (1 - stream["skipped"])
    assert 0 < stream["track"]["p50"] <= stream["track"]["max"]
    assert 0 < stream["model"]["p50"] <= stream["model"]["max"]
    (receipts,) = figures["subscribers"]
    assert receipts["latency"]["p50"] > 0
    assert len(receipts["received"]) == 1
    assert {"detector 0", "compressor 0", "trainer 0", "camera", "subscribers"} <= set(figures["processes"])
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 1 + 60 * (2 + 1)  # tracks, models, one fast subscriber

    succeed("loadtest", "compare", "x.json", "x.json", cwd=tmp_path)
    (tmp_path / "y.json").write_text(json.dumps({**figures, "figures": {**figures["figures"], "p50": 60.0}}))
    code, output, _ = said("loadtest", "compare", "x.json", "y.json", "--tolerance", "20%", cwd=tmp_path)
    assert (code, output.splitlines()[-1]) == (1, "Regression: p50.")

    page = (tmp_path / "load.html").read_text()
    assert not re.search(r"(src|href)=|<script|@import|url\(|nan", page)


def test_recording_is_compared_with_an_unloaded_run(succeed, demo_video, tmp_path):
    path, boxes = demo_video(32)
    arguments = ["--video", path, "--box", f"dahlia={boxes[0]}", "--source", "h264", "--duration", 2]
    output, _ = succeed("loadtest", *arguments, "--limit", "skipped=1", "--json", "x.json", cwd=tmp_path)
    assert "Sustained: 1 stream of demo.mp4, 320x240 pixels (h264), 30 frames/s" in output
    figures = json.loads((tmp_path / "x.json").read_text())
    assert 0 <= figures["streams"][0]["success"] <= 1
    assert (figures["plan"]["video"], [*figures["plan"]["boxes"]]) == ("demo.mp4", ["dahlia"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--size", "640"], "a size is WIDTHxHEIGHT"),
        (["--limit", "subscriber-p99=1"], "requires fast ones: raise --subscribers"),
        (["--limit", "p98=1"], "a limit is NAME=VALUE with one of p50"),
        (["--report", "/dev/null/load.html"], "cannot write"),
        (["--set", "run.lockstep=true"], "omit run.lockstep"),
        (["--set", "run.nothing=1"], "run.nothing"),
        (["--video", "none.mp4", "--box", "1,1,9,9"], "there is no video or folder"),
        (["--video", "none.mp4", "--size", "640x480"], "omit --size and --objects"),
        (["--box", "1,1,9,9"], "pass --video FILE as well"),
        (["compare", "none.json", "none.json"], "none.json is not a result of a load test"),
        (["compare", "none.json", "none.json", "--tolerance", "0.1"], "a tolerance is a percentage"),
    ],
)
def test_invalid_arguments_are_usage_errors_before_the_start(fail, tmp_path, arguments, message):
    error = fail("loadtest", *arguments, cwd=tmp_path)
    assert message in error
    assert error.startswith("Error: "), "the exit status 1 would mean that the load was not sustained"
