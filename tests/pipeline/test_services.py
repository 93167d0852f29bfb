"""The processes by themselves: started by hand, in any order, and ended in any way."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from dataclasses import replace

import cv2
import psutil
import pytest

from catstream.box import Box
from catstream.compression.checkpoint_store import CheckpointStore
from catstream.errors import ServiceError
from catstream.messages.kinds import End, Track
from catstream.pipeline import Pipeline
from catstream.run.job import Job
from catstream.run.state import TREES
from catstream.services.child import Child
from catstream.services.start import environment, python_command
from catstream.services.start_server import NAMES, start_server
from catstream.services.supervisor import Supervisor
from catstream.settings import Settings
from catstream.sinks.recording.file import Recording
from catstream.video.source import open_source
from catstream.wire.channels import HEALTH, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Subscriber


@pytest.mark.parametrize(
    "order", [("detector", "trainer", "compressor"), ("trainer", "compressor", "detector")], ids=" ".join
)
def test_processes_started_manually_in_any_order_complete_a_run(video, folder, tcp, service, order):
    path, boxes = video
    arguments = {
        "compressor": ["--state", folder],
        "trainer": [],
        "detector": ["--resume", path, "--box", ",".join(map(str, boxes[0]))],
    }
    processes = [service(name, "--set", f"run.endpoint={tcp}", *arguments[name]) for name in order]
    assert [process.wait(120) for process in processes] == [0, 0, 0]
    assert CheckpointStore(folder / TREES).load(Settings()).seq == len(boxes)


@pytest.fixture
def broken(video, tmp_path):
    """A source that breaks at its sixth frame, and the object's box."""
    path, boxes = video
    with open_source(path) as source:
        for frame, _ in zip(source, range(9), strict=False):
            cv2.imwrite(str(tmp_path / f"{frame.number}.png"), frame.image)
    (tmp_path / "5.png").write_text("no image")
    return tmp_path, ",".join(map(str, boxes[0]))


def test_a_source_that_breaks_ends_its_supervisor_with_the_reason(broken, service):
    source, box = broken
    supervisor = service("supervisor", source, "--box", box)
    errors = supervisor.communicate(timeout=60)[1]
    assert supervisor.returncode == 3, errors
    assert "5.png' (frame 5): replace or remove it" in errors
    assert "restarted" not in errors


def test_a_source_that_breaks_ends_processes_that_were_started_by_hand(broken, folder, service):
    source, box = broken
    arguments = {"compressor": ["--state", folder], "trainer": [], "detector": [source, "--box", box]}
    processes = [service(name, "--set", f"run.endpoint={folder}", *given) for name, given in arguments.items()]
    errors = [process.communicate(timeout=60)[1] for process in processes]
    assert [process.returncode for process in processes] == [3, 3, 3], errors
    assert "5.png' (frame 5): replace or remove it" in errors[-1]
    assert CheckpointStore(folder / TREES).load(Settings()).seq == 5


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 0), (signal.SIGKILL, -9)])
def test_no_process_outlives_its_supervisor(video, service, number, code, until, alive):
    path, boxes = video
    supervisor = service("supervisor", path, "--box", ",".join(map(str, boxes[0])))
    started = psutil.Process(supervisor.pid)
    children = until(lambda: len(found := started.children(recursive=True)) == 1 + len(NAMES) and found)
    supervisor.send_signal(number)
    assert supervisor.wait(30) == code
    until(lambda: not any(alive(child.pid) for child in children))


def test_processes_that_are_stopped_together_end_in_order_and_all_is_stored(video, endless, folder, service, until):
    _, boxes = video
    arguments = {
        "compressor": ["--state", folder, "--record", folder / "run.rec"],
        "trainer": [],
        "detector": ["--record", folder / "run.rec", endless, "--box", ",".join(map(str, boxes[0]))],
    }
    with Subscriber(TRACKS, Endpoint.parse(str(folder))) as tracks:
        place = ["--set", f"run.endpoint={folder}"]
        processes = [service(name, *place, *given) for name, given in arguments.items()]
        until(lambda: isinstance(track := tracks.receive(0.1), Track) and track.frame >= 5)
        for process in processes:
            process.send_signal(signal.SIGTERM)
        end = until(lambda: next((m for m in iter(lambda: tracks.receive(0.1), None) if isinstance(m, End)), None))
        assert [process.wait(30) for process in processes] == [0, 0, 0]
    assert end.totals["sent"] > 5
    assert end.totals["stored"] == end.totals["sent"]
    assert Recording(folder / "run.rec").end is not None


def test_a_compressor_that_ends_alone_stores_its_features_and_exits(video, folder, service, until):
    path, boxes = video
    arguments = {"compressor": ["--state", folder], "detector": [path, "--box", ",".join(map(str, boxes[0]))]}
    place = [
        "--set",
        f"run.endpoint={folder}",
        "--set",
        "run.checkpoint_seconds=3600",
        "--set",
        "run.unstored_frames=2000",
    ]
    with Subscriber(HEALTH, Endpoint.parse(str(folder))) as health:
        compressor, detector = (service(name, *place, *given) for name, given in arguments.items())
        # Without a trainer the detector stands still, with features that were taken and not stored.
        told = (report.counters for report in iter(lambda: health.receive(60), None) if report.process == "detector")
        taken = next(counters["taken"] for counters in told if counters["taken"])
        compressor.send_signal(signal.SIGTERM)
        assert compressor.wait(30) == 0
        stored = CheckpointStore(folder / TREES).load(Settings()).seq
        assert stored >= taken
        service("compressor", *place, *arguments["compressor"])  # tells it, if the last answer was lost
        until(lambda: next(told)["stored"] >= stored)
    assert detector.poll() is None


def test_a_process_whose_parent_has_already_ended_ends_at_once(folder):
    arguments = "trainer", str(Job(endpoint=str(folder)).save(folder)), False, 2**22 + 1, 0
    command = python_command(f"from catstream.services.start_server import run_started; run_started{arguments!r}")
    assert subprocess.run(command, env=environment(), timeout=60, check=False).returncode == 0


def test_an_error_that_a_restart_cannot_resolve_is_reported_and_not_retried(folder, caplog):
    supervisor = Supervisor(Job(str(folder / "gone.mp4"), {"": Box(1, 1, 9, 9)}, endpoint=str(folder)), folder)
    try:
        with pytest.raises(ServiceError, match=r"no video or folder .*gone\.mp4"):
            check_for_a_minute(supervisor)
        assert "the detector" not in caplog.text  # another process may hang on a busy machine
    finally:
        supervisor.stop()


def test_processes_that_have_started_end_if_one_after_them_cannot_start(video, folder, monkeypatch, alive):
    start, pids = Child.start, []

    def start_two(child):
        if child.name == "trainer":
            raise OSError(24, "Too many open files")
        start(child)
        pids.append(child.pid)

    monkeypatch.setattr(Child, "start", start_two)
    with pytest.raises(OSError, match="Too many open files"):
        Supervisor(Job(video[0], {"": video[1][0]}, endpoint=str(folder)), folder)
    assert len(pids) == 2
    assert not any(map(alive, pids))


def test_a_process_that_dies_repeatedly_ends_the_pipeline(video, folder):
    path, boxes = video
    supervisor = Supervisor(Job(path, {"": boxes[0]}, endpoint=str(folder), owned=True), folder)

    def kill_trainer():
        if (pid := supervisor.pids.get("trainer")) is not None:  # it may end at any moment
            os.kill(pid, signal.SIGKILL)

    try:
        with pytest.raises(ServiceError, match=r"the trainer died 6 times in a minute, .* SIGKILL"):
            check_for_a_minute(supervisor, kill_trainer)
        assert supervisor.restarts == 6
    finally:
        supervisor.stop()


def test_a_process_that_is_restarted_continues_the_run_and_a_resume_is_another_one(video, folder):
    path, boxes = video
    job, runs = Job(path, {"": boxes[0]}, endpoint=str(folder), owned=True), []
    for resume in (False, True):
        supervisor = Supervisor(replace(job, resume=resume), folder)
        try:
            with Subscriber(HEALTH, Endpoint.parse(str(folder))) as reports:
                before = runs_of_all(supervisor, reports)
                os.kill(killed := supervisor.pids["detector"], signal.SIGKILL)
                while supervisor.pids.get("detector", killed) == killed:
                    supervisor.check_children()
            with Subscriber(HEALTH, Endpoint.parse(str(folder))) as reports:
                assert runs_of_all(supervisor, reports) == before
        finally:
            supervisor.stop()
        assert len(before) == 1, "the processes agree"
        runs += before
    assert len(set(runs)) == 2
    assert "" not in runs


def runs_of_all(supervisor, reports):
    """The runs that the health reports of all processes are from."""
    runs, deadline = {}, time.monotonic() + 60
    while runs.keys() < set(NAMES) and time.monotonic() < deadline:
        supervisor.check_children()
        if (report := reports.receive(0.1)) is not None:
            runs[report.process] = reports.run
    assert runs.keys() == set(NAMES)
    return set(runs.values())


def check_for_a_minute(supervisor, turn=lambda: None):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        turn()
        supervisor.check_children()
        time.sleep(0.01)


def test_a_start_server_that_a_signal_has_stopped_is_replaced_once_a_process_has_to_be_restarted(video):
    path, boxes = video
    tracks = []
    with Pipeline(path, boxes[0], Settings(run={"unstored_frames": 16})) as pipeline:
        for track in pipeline:
            tracks.append(track.frame)
            if track.frame == 5:
                stopped = start_server().pid
                os.kill(stopped, signal.SIGSTOP)
                os.kill(pipeline.pids["detector"], signal.SIGKILL)
        assert start_server().pid != stopped
        assert not psutil.pid_exists(stopped)
        assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(boxes), len(boxes))
    assert tracks == list(range(len(boxes)))


def test_processes_that_hang_are_detected_and_replaced(video):
    path, boxes = video
    stopped, tracks = [], []
    with Pipeline(path, boxes[0], Settings(run={"unstored_frames": 16})) as pipeline:
        for track in pipeline:
            tracks.append(track.frame)
            if track.frame == 5:
                stopped = list(pipeline.pids.values())
                for pid in stopped:
                    os.kill(pid, signal.SIGSTOP)
        assert len(stopped) == len(NAMES)
        assert pipeline.restarts >= len(NAMES)
        assert not any(map(psutil.pid_exists, stopped))
        assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(boxes), len(boxes))
    assert tracks == list(range(len(boxes)))
