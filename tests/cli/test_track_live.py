"""`catstream track` of live streams, until Ctrl-C."""

import csv
import re
import signal
from contextlib import contextmanager

import cv2
import psutil
import pytest

from catstream.base.box import Box
from catstream.client.attach import subscribe
from catstream.video.rendered import render


@pytest.fixture(scope="module")
def story():
    """The demo's first images and boxes, forwards and backwards: a loop without a jump."""
    frames = list(render(60, (320, 240)))
    return frames + frames[-2:0:-1]


class Run:
    """A run of `catstream track`, seen from outside."""

    def __init__(self, process, output, health):
        self.process, self.output, self._health = process, output, health

    def until(self, condition):
        """Wait until the detector's counters are so."""
        for report in self._health:
            if report.process == "detector" and condition(report.counters):
                return report.counters
        raise AssertionError(f"the run has ended: {self.process.poll()}")

    def stopped(self):
        """Its rows and what it said, after Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        errors = self.process.communicate(timeout=500)[1]
        assert self.process.returncode == 130
        rows = list(csv.DictReader((self.output / "one.csv").read_text().splitlines()))
        assert len((self.output / "one.ndjson").read_text().splitlines()) == 1 + len(rows)
        return rows, errors


@pytest.fixture
def following(catstream, story, tmp_path):
    """Follows the object of the story in a stream."""

    @contextmanager
    def start(url, *more):
        output, place = tmp_path / "out", tmp_path / "run"
        with subscribe(str(place), "health", timeout=500) as health:
            box = ",".join(map(str, story[0][1]))
            command = ("track", url, "--box", box, "--output", output, "--set", f"run.endpoint={place}", *more)
            yield Run(catstream(*command), output, health)

    return start


def found(row, story):
    """Whether the box of a row is where the object is in some image of the story."""
    box = row["x"] and Box(*(float(row[name]) for name in "xywh"))
    return bool(box) and max(box.overlap(truth) for _, truth in story) > 0.6


def test_restarted_detector_scales_frames_of_another_size(camera, following, story):
    scale = [1]
    cam = camera(lambda number: cv2.resize(story[number % len(story)][0], None, fx=scale[0], fy=1))
    with following(cam.url) as run:
        sent = run.until(lambda counters: counters["model_version"] >= 3)["sent"]
        scale[0] = 2
        (server,) = psutil.Process(run.process.pid).children()
        detector, *_ = sorted(server.children(), key=psutil.Process.create_time)  # it is the first that is started
        detector.kill()
        run.until(lambda counters: counters["sent"] > sent + 80)
        rows, errors = run.stopped()
    assert "processes restarted: 1" in errors
    assert [int(row["frame"]) for row in rows] == list(range(len(rows)))
    seconds = [float(row["seconds"]) for row in rows]
    assert seconds == sorted(seconds)
    assert sum(found(row, story) for row in rows) > 0.8 * len(rows)


def test_ctrl_c_ends_a_run_with_a_lost_stream(camera, following, said, story, tmp_path):
    cam = camera(lambda number: story[number % len(story)][0])
    with following(cam.url) as run, subscribe(str(tmp_path / "run"), "tracks", timeout=500) as tracks:
        next(tracks)
        cam.leave()
        run.until(lambda counters: counters.get("lost_seconds", 0) > 0)
        code, status, _ = said("status", "--endpoint", tmp_path / "run", "--wait", 150)
        assert code == 0, "the processes are well"
        assert re.search(r"^state +source lost for \d+ s$", status, re.MULTILINE)
        assert re.search(r"^source +\d+ frames? skipped, 0 reconnects$", status, re.MULTILINE)
        rows, errors = run.stopped()
        assert len(list(tracks)) < len(rows)
        assert (tracks.end.reason, tracks.end.failed) == ("it was stopped", False)
    assert "lost source one" in errors
    assert "the results so far are kept" in errors


REJECTED = {"omit lockstep": ["--lockstep"], "has no start, end or stride": ["--start=9"], "connection refused": []}


@pytest.mark.parametrize(("words", "options"), REJECTED.items(), ids=REJECTED)
def test_unsupported_options_of_a_stream_are_an_error(fail, tmp_path, options, words):
    assert words in fail("track", "http://127.0.0.1:1/one", "--box", "10,10,20,20", *options, cwd=tmp_path)
    assert not list(tmp_path.iterdir())
