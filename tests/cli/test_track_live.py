"""`catstream track` of a live stream, until Ctrl-C."""

import csv
import re
import signal

import cv2
import psutil
import pytest

from catstream.base.box import Box
from catstream.client.attach import subscribe
from catstream.video.rendered import render


def test_live_run_continues_after_faults_until_ctrl_c(camera, catstream, said, tmp_path):
    frames = list(render(60, (320, 240)))
    frames += frames[-2:0:-1]  # forwards and backwards: a loop without a jump
    scale, output, endpoint = [1], tmp_path / "out", tmp_path / "run"
    cam = camera(lambda number: cv2.resize(frames[number % len(frames)][0], None, fx=scale[0], fy=1))
    box = ",".join(map(str, frames[0][1]))
    with subscribe(str(endpoint), "health", timeout=500) as health:
        run = catstream("track", cam.url, "--box", box, "--output", output, "--set", f"run.endpoint={endpoint}")
        detector = (report.counters for report in health if report.process == "detector")
        sent = next(counters["sent"] for counters in detector if counters["model_version"] >= 3)
        # The detector is restarted, and the frames change their size.
        scale[0] = 2
        (server,) = psutil.Process(run.pid).children()
        min(server.children(), key=psutil.Process.create_time).kill()  # the detector is the first that is started
        assert any(counters["sent"] > sent + 80 for counters in detector)
        # The stream is lost.
        cam.leave()
        assert any(counters.get("lost_seconds", 0) > 0 for counters in detector)
        code, status, _ = said("status", "--endpoint", endpoint, "--wait", 150)
        assert code == 0, "all processes report"
        assert re.search(r"^state +source lost for \d+ s$", status, re.MULTILINE)
        assert re.search(r"^source +\d+ frames? skipped, 0 reconnects$", status, re.MULTILINE)
        run.send_signal(signal.SIGINT)
        errors = run.communicate(timeout=500)[1]
        list(detector)
        assert (health.end.reason, health.end.failed) == ("it was stopped", False)
    assert run.returncode == 130
    for message in ("processes restarted: 1", "lost source one", "the results so far are kept"):
        assert message in errors
    rows = list(csv.DictReader((output / "one.csv").read_text().splitlines()))
    assert len((output / "one.ndjson").read_text().splitlines()) == 1 + len(rows)
    assert [int(row["frame"]) for row in rows] == list(range(len(rows)))
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)
    boxes = [Box(*(float(row[name]) for name in "xywh")) for row in rows if row["x"]]
    assert sum(max(box.overlap(truth) for _, truth in frames) > 0.6 for box in boxes) > 0.8 * len(rows)


REJECTED = {"needs a file": ["--lockstep"], "has no start, end or stride": ["--start=9"], "connection refused": []}


@pytest.mark.parametrize(("words", "options"), REJECTED.items(), ids=REJECTED)
def test_unsupported_options_of_a_stream_are_an_error(fail, tmp_path, options, words):
    assert words in fail("track", "http://127.0.0.1:1/one", "--box", "10,10,20,20", *options, cwd=tmp_path)
    assert not list(tmp_path.iterdir())
