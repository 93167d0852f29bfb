"""`catstream track` on streams that never end: followed until Ctrl-C, whatever happens to them."""

import csv
import re
import signal
import subprocess
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2
import psutil
import pytest

from catstream.base.box import Box
from catstream.client.attach import subscribe
from catstream.pipeline import Pipeline
from catstream.video.rendered import render

PYTHON = Path("/usr/bin/python3")  # the one that Debian's packages are for
SERVER = Path(__file__).with_name("rtsp_server.py")
HOW_TO_GET_IT = (
    "no real RTSP server: apt-get install --no-install-recommends python3-gi gir1.2-gst-rtsp-server-1.0 "
    "gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-ugly"
)


@pytest.fixture(scope="module")
def story():
    """The demo's first images and boxes, forwards and backwards: a loop without a jump."""
    frames = list(render(60, (320, 240)))
    return frames + frames[-2:0:-1]


@pytest.fixture
def rtsp(story, tmp_path):
    """Starts RTSP servers that show the story: the process and the port."""
    folder = tmp_path / "story"
    folder.mkdir()
    for number, (image, _) in enumerate(story):
        cv2.imwrite(str(folder / f"{number:05d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    with ExitStack() as stack:

        def start(port=0):
            if not PYTHON.exists():
                pytest.skip(HOW_TO_GET_IT)
            process = subprocess.Popen([PYTHON, SERVER, folder, str(port)], stdout=subprocess.PIPE, text=True)
            stack.callback(process.communicate)
            stack.callback(process.kill)
            if said := process.stdout.readline():
                return process, int(said)
            assert process.wait() == 3, "the RTSP server does not start"
            pytest.skip(HOW_TO_GET_IT)

        yield start


class Run:
    """A run of `catstream track`, seen from outside."""

    def __init__(self, process, output, health):
        self.process, self.output, self._health = process, output, health

    def until(self, condition):
        """Wait until the detector's counters are so."""
        for report, _ in zip(self._health, range(180), strict=False):
            if report.process == "detector" and condition(report.counters):
                return report.counters
        raise AssertionError(f"it did not happen in time: {self.process.poll()}")

    def stopped(self):
        """Its rows and what it said, after Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        errors = self.process.communicate(timeout=150)[1]
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
        with subscribe(str(place), "health", timeout=150) as health:
            box = ",".join(map(str, story[0][1]))
            command = ("track", url, "--box", box, "--output", output, "--set", f"run.endpoint={place}", *more)
            yield Run(catstream(*command), output, health)

    return start


def found(row, story):
    """Whether the box of a row is where the object is in some image of the story."""
    box = row["x"] and Box(*(float(row[name]) for name in "xywh"))
    return bool(box) and max(box.overlap(truth) for _, truth in story) > 0.6


@pytest.mark.system
def test_tracking_resumes_with_the_learned_model_after_a_server_freezes_and_dies(rtsp, following, story):
    server, port = rtsp()
    with following(f"rtsp://127.0.0.1:{port}/one") as run:
        run.until(lambda counters: counters["model_version"] >= 5)
        server.send_signal(signal.SIGSTOP)
        run.until(lambda counters: counters.get("lost_seconds", 0) > 0)
        server.send_signal(signal.SIGCONT)
        run.until(lambda counters: counters["reconnects"] == 1)
        server.kill()
        server.wait()
        learned = run.until(lambda counters: counters.get("lost_seconds", 0) > 0)["model_version"]
        rtsp(port)
        run.until(lambda counters: counters["reconnects"] == 2 and counters["model_version"] >= learned + 5)
        rows, errors = run.stopped()
    assert "lost source one (no data: " in errors
    assert errors.count("reconnected to source one after") == 2
    assert "skipped, 2 reconnects" in errors
    assert [int(row["frame"]) for row in rows] == list(range(len(rows)))
    versions = [int(row["model_version"]) for row in rows]
    assert versions == sorted(versions), "what was learned is kept"
    assert sum(found(row, story) for row in rows[-20:]) > 15


def test_a_restarted_detector_tracks_an_http_stream_whose_frames_changed_their_size(camera, following, story):
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


def test_ctrl_c_ends_a_run_whose_stream_is_lost(camera, following, said, story, tmp_path):
    cam = camera(lambda number: story[number % len(story)][0])
    with following(cam.url) as run, subscribe(str(tmp_path / "run"), "tracks", timeout=150) as tracks:
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
def test_options_that_a_stream_does_not_support_are_rejected_before_anything_starts(fail, tmp_path, options, words):
    assert words in fail("track", "http://127.0.0.1:1/one", "--box", "10,10,20,20", *options, cwd=tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_frames_of_a_stream_cannot_be_read_again_for_a_video(camera, fail, story, tmp_path):
    cam = camera(lambda _: story[0][0])
    with Pipeline(cam.url, story[0][1], state=tmp_path / "kept"):
        pass
    for run in ([cam.url, "--box", ",".join(map(str, story[0][1]))], ["--resume", tmp_path / "kept"]):
        assert "omit the video" in fail("track", *run, "--output", tmp_path / "out", "--video")
        assert not (tmp_path / "out").exists()
