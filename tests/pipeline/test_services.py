"""The processes by themselves: started by hand, in any order, and ended in any way."""

import os
import signal
import subprocess
import sys
import time
from itertools import islice

import psutil
import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.coreset.checkpoint_store import CheckpointStore
from catstream.errors import CatstreamError
from catstream.pipeline import Pipeline
from catstream.processes import by_hand as scripts
from catstream.processes.job import Job
from catstream.processes.shared import RUNNING_SECONDS
from catstream.processes.start_server import NAMES
from catstream.processes.state import CHECKPOINTS
from catstream.processes.supervisor import Child, Supervisor
from catstream.wire.channels import TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Track
from catstream.wire.newest import Subscriber


@pytest.fixture
def by_hand(service, folder):
    """Starts processes of a run by hand, in an order; the checkpoints are in `folder`."""

    def start(*source, box, order=("compressor", "trainer", "detector"), endpoint=folder):
        words = {"compressor": ["--state", folder], "trainer": [], "detector": [*source, "--box", box]}
        return [service(name, "--set", f"run.endpoint={endpoint}", *words[name]) for name in order]

    return start


def test_processes_started_in_any_order_complete_a_run(video, folder, tcp, by_hand):
    """In the opposite order: in the usual one they are started below."""
    path, boxes = video
    order = "detector", "trainer", "compressor"
    processes = by_hand("--resume", path, box=boxes[0], order=order, endpoint=tcp)
    assert [process.wait(500) for process in processes] == [0, 0, 0]
    assert CheckpointStore(folder / CHECKPOINTS).load(Settings()).seq == len(boxes)


def test_process_started_alone_names_the_missing_ones(video, folder, service):
    detector = service("detector", "--set", f"run.endpoint={folder}", video[0], "--box", video[1][0])
    line = next(line for line in detector.stderr if "waiting" in line)
    assert line == f"detector: waiting at {folder} for services/compressor.py and services/trainer.py\n"


PROGRAM = """
import catstream, signal, sys

with catstream.Pipeline(sys.argv[1], sys.argv[2]) as pipeline:
    print(*pipeline.pids.values(), flush=True)
    signal.pause()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_its_program(video, number, until, alive):
    command = [sys.executable, "-c", PROGRAM, video[0], ",".join(map(str, video[1][0]))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as program:
        pids = [int(pid) for pid in program.stdout.readline().split()]
        pids.append(psutil.Process(pids[0]).ppid())
        program.send_signal(number)
        program.wait(500)
    assert len(pids) == 1 + len(NAMES)
    until(lambda: not any(map(alive, pids)))


def test_processes_stopped_together_store_all_messages(video, endless, folder, by_hand, until):
    with Subscriber(TRACKS, Endpoint.parse(str(folder))) as tracks:
        processes = by_hand(endless, box=video[1][0])
        until(lambda: isinstance(track := tracks.receive(0.1), Track) and track.model_version)  # all have started
        for process in processes:
            process.send_signal(signal.SIGTERM)
        end = until(lambda: next((m for m in iter(lambda: tracks.receive(0.1), None) if isinstance(m, End)), None))
        assert [process.wait(500) for process in processes] == [0, 0, 0]
    assert end.totals["stored"] == end.totals["sent"]


def failed(job, folder):
    """The error with which a run fails."""
    supervisor = Supervisor(job, folder)
    try:
        with pytest.raises(CatstreamError) as raised:
            list(iter(supervisor.next_frame, None))
        return str(raised.value), supervisor.restarts
    finally:
        supervisor.stop()


def test_error_that_a_restart_cannot_resolve_is_not_retried(folder, caplog):
    job = Job(str(folder / "gone.mp4"), {"": Box(1, 1, 9, 9)}, endpoint=str(folder))
    error, restarts = failed(job, folder)
    assert ("no video or folder" in error, restarts) == (True, 0)
    assert "detector died" not in caplog.text  # another process may hang on a busy machine


def test_process_that_dies_repeatedly_ends_the_pipeline(video, folder, monkeypatch):
    start = Child.start

    def start_and_kill(child, after):
        start(child, after)
        if child.name == "trainer":
            child.process.send_signal(signal.SIGKILL)

    monkeypatch.setattr(Child, "start", start_and_kill)
    error, restarts = failed(Job(video[0], {"": video[1][0]}, endpoint=str(folder)), folder)
    assert error.startswith("the trainer died 6 times in a minute (last: signal SIGKILL, not sent by catstream")
    assert restarts == 6


def test_hanging_processes_are_replaced_while_the_program_waits(video, until):
    path, boxes = video
    with Pipeline(path, boxes[0], Settings(run={"unstored_frames": 16})) as pipeline:
        tracks = list(islice(pipeline, 5))
        stopped = pipeline.pids
        for name, pid in stopped.items():
            os.kill(pid, signal.SIGSTOP)
            watchdog = pipeline._supervisor._children[name].memory.watchdog
            while watchdog.patience > RUNNING_SECONDS:  # a step that may take long
                os.kill(pid, signal.SIGCONT)
                time.sleep(0.01)
                os.kill(pid, signal.SIGSTOP)
        until(lambda: not any(map(psutil.pid_exists, stopped.values())))
        tracks.extend(pipeline)
        assert pipeline.restarts >= len(stopped) == len(NAMES)
        assert (pipeline.totals["sent"], pipeline.totals["stored"]) == (len(boxes), len(boxes))
    assert [track.frame for track in tracks] == list(range(len(boxes)))


def test_detector_started_by_hand_ignores_empty_options(monkeypatch):
    jobs = []
    monkeypatch.setattr(scripts, "run", lambda _, job: jobs.append(job))
    words = ["detector.py", "walk.mp4", "--box=", "--box=anna=1,2,30,30", "--model=", "--model=ben=b.safetensors"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit):
        scripts.main("detector")
    assert [*jobs[0].boxes, *jobs[0].models] == ["anna", "ben"]
