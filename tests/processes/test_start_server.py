"""The start server forks the processes of a program's pipelines, and ends with it; and the log of a process."""

import os
import resource
import signal
import subprocess
import sys
from contextlib import closing, suppress
from pathlib import Path
from unittest.mock import Mock

import psutil
import pytest

from catstream.errors import ServiceError
from catstream.processes import start_server as module
from catstream.processes.job import Job
from catstream.processes.process import STOPPED_EARLY
from catstream.processes.shared import SharedMemory
from catstream.processes.start_server import start_server
from catstream.processes.supervisor import Child, ProcessLog


@pytest.fixture
def own_server(monkeypatch):
    """The next start server is the test's own."""
    monkeypatch.setattr(module, "_server", None)
    yield
    module.close_start_server()


@pytest.fixture
def start(folder, tmp_path, until):
    """Starts a trainer, which runs until it is ended; its process, its memory and its log."""
    started = []

    def trainer(job=None):
        place = folder / str(len(started))
        place.mkdir()
        file = job or Job(endpoint=str(place)).save(place)
        log, memory = ProcessLog("trainer", (tmp_path / f"{len(started)}.log").open("w+b")), SharedMemory()
        process = start_server().start("trainer", file, log.fileno(), memory.handle, restarted=False)
        started.append((process, memory, log))
        until(lambda: job or memory.watchdog.iterations > 2)
        return started[-1]

    yield trainer
    for process, memory, log in started:
        process.close()
        memory.close()
        log.close()


def opened(pid):
    """The targets of the descriptors of a process."""
    places = {}
    for name in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # it opens and closes files meanwhile
            places[name.name] = str(name.readlink())
    return places


def test_process_inherits_the_folder_and_no_file_of_the_server(start, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    started, _, log = start()
    process, server = psutil.Process(started.pid), start_server()
    assert process.ppid() == server.pid
    assert process.cwd() == str(tmp_path)
    assert os.getsid(process.pid) == server.pid != os.getsid(0), "Ctrl-C is for the program"
    found = opened(process.pid)
    assert found["0"] == found["1"] == "/dev/null"
    assert found["2"] == str(Path(f"/proc/self/fd/{log.fileno()}").readlink())
    of_the_server = {place for place in opened(server.pid).values() if place.startswith(("socket:", "pipe:"))}
    assert not of_the_server & {*found.values()}
    assert psutil.Process(server.pid).num_threads() == 1, "a fork copies only one"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 4), (signal.SIGKILL, -signal.SIGKILL)])
def test_exit_code_or_signal_of_a_process_is_known(start, until, number, code):
    process, *_ = start()
    assert process.poll() is None
    process.send_signal(number)
    assert until(process.poll) == code
    assert process.pid == 0


@pytest.mark.usefixtures("own_server")
def test_processes_end_with_their_start_server(start, alive, until):
    process, *_ = start()
    running, server = process.pid, start_server()
    os.kill(server.pid, signal.SIGKILL)
    assert until(process.poll) == -signal.SIGKILL
    assert process.lost
    until(lambda: not alive(running))
    again, *_ = start()
    assert psutil.Process(again.pid).ppid() == start_server().pid != server.pid


def test_processes_run_if_their_program_has_no_standard_streams(tmp_path, folder):
    """As after `nohup ... <&- >&- 2>&- &`."""
    job, log = Job(endpoint=str(folder)).save(tmp_path), tmp_path / "log"
    program = f"""
import os, time
from pathlib import Path
from catstream.processes.start_server import start_server
from catstream.processes.shared import SharedMemory
with open({str(log)!r}, "w+b") as log:
    memory = SharedMemory()
    process = start_server().start("trainer", Path({str(job)!r}), log.fileno(), memory.handle, restarted=False)
    while memory.watchdog.iterations < 3 and process.poll() is None:
        time.sleep(0.01)
    code = process.poll()
    process.close()
os._exit(0 if code is None else 1)
"""
    closed = subprocess.run([sys.executable, "-c", program], check=False, preexec_fn=lambda: os.closerange(0, 3))
    assert closed.returncode == 0


@pytest.mark.usefixtures("own_server")
def test_process_begins_with_no_blocked_signal_and_most_files(start, until):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, 512), hard))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGCHLD})
    try:
        process, memory, _ = start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    until(lambda: memory.watchdog.iterations > 2)
    assert psutil.Process(process.pid).rlimit(psutil.RLIMIT_NOFILE) == (hard, hard)
    process.send_signal(signal.SIGTERM)
    assert until(process.poll) == 4


def test_start_server_that_cannot_run_is_an_error(monkeypatch, until):
    monkeypatch.setattr(module, "_server", None)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    server = start_server()
    until(lambda: server._process.poll() is not None)
    with pytest.raises(ServiceError, match="/bin/false did not start"):
        start_server()
    assert module._server is None


def test_forked_copy_of_a_program_starts_its_own_server():
    server = start_server()
    reading, writing = os.pipe()
    if not (pid := os.fork()):
        copy = start_server()
        os.write(writing, str(copy.pid).encode())
        copy.close()
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0
    assert int(os.read(reading, 100)) != server.pid
    assert psutil.pid_exists(server.pid)
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize(("name", "value"), [("frozen", True), ("executable", ""), ("executable", "/gone/python")])
def test_program_without_an_interpreter_gets_one_clear_error(monkeypatch, name, value):
    monkeypatch.setattr(module, "_server", None)
    monkeypatch.setattr(sys, name, value, raising=False)
    with pytest.raises(ServiceError, match="run it with python"):
        start_server()


def test_log_yields_the_whole_lines_of_the_process_itself(tmp_path):
    with (tmp_path / "log").open("w+b") as file, closing(ProcessLog("detector", file)) as log:
        file.write(b"detector: an earlier one\n")
        file.flush()
        log.begin()
        assert log.last_line() == ""
        file.write(b"detector: one\nTraceback\ndetector: tw")
        file.flush()
        assert log.new_lines() == ["an earlier one", "one"]
        file.write(b"o\n")
        file.flush()
        assert log.new_lines() == ["two"]
        assert log.last_line() == "two"
        file.write(b"detector: " + bytes(200_000) + b"\ndetector: the source is lost\n")  # longer than is read at once
        file.flush()
        assert [line for _ in range(9) for line in log.new_lines()] == ["the source is lost"]


@pytest.mark.parametrize(
    ("code", "ending"),
    [
        (-signal.SIGKILL, "signal SIGKILL, not sent by catstream; out of memory?"),
        (-(signal.SIGRTMIN + 1), f"signal {signal.SIGRTMIN + 1}"),
        (1, "exit code 1: its last line"),
        (STOPPED_EARLY, "another program asked it to end with a signal"),
    ],
)
def test_reason_of_a_death_has_the_signal_and_the_last_line(tmp_path, code, ending):
    child = Child("trainer", tmp_path, tmp_path)
    with closing(child.log), (tmp_path / "trainer.log").open("ab") as file:
        file.write(b"trainer: its last line\n")
        file.flush()
        assert child.ending(code) == ending
        child.log.begin()
        assert child.ending(code) == ending.removesuffix(": its last line")


def test_reason_of_a_death_names_the_start_server_or_watchdog(tmp_path):
    child = Child("trainer", tmp_path, tmp_path)
    with closing(child.log):
        child.process = Mock(lost=True, server_code=-signal.SIGTERM)
        assert child.ending(-signal.SIGKILL) == "with the start server: signal SIGTERM"
        child.hung = True
        assert child.ending(-signal.SIGKILL) == "killed after it made no progress"


@pytest.mark.parametrize(
    ("source", "name", "line", "nicer"),
    [
        ("rtsp://me:secret@10.0.0.7/gate", "trainer:gate", "catstream trainer rtsp://10.0.0.7/gate", 5),
        ("a.mp4", "trainer:a.mp4", "catstream trainer a.mp4", 0),
    ],
)
def test_process_title_has_the_stream_without_its_password(start, folder, until, source, name, line, nicer):
    process, _, _ = start(Job(source, endpoint=str(folder)).save(folder))
    trainer = psutil.Process(process.pid)
    until(lambda: trainer.cmdline()[0] == line[: len(trainer.cmdline()[0])])
    assert Path(f"/proc/{process.pid}/comm").read_text() == f"{name}\n"
    assert "secret" not in Path(f"/proc/{process.pid}/cmdline").read_text()
    assert trainer.nice() == min(psutil.Process().nice() + nicer, 19)
