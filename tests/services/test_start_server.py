"""The start server forks the processes of a program's pipelines, and ends with the program."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from catstream.run.job import Job
from catstream.services import start_server as module
from catstream.services.process_log import ProcessLog
from catstream.services.start_server import StartRequest, start_server
from catstream.services.watchdog import Watchdog


@pytest.fixture
def server(monkeypatch):
    """A start server of the test's own, the one that `start_server` returns."""
    monkeypatch.setattr(module, "_servers", [])
    yield start_server()
    for each in module._servers:
        each.close()


@pytest.fixture
def start(server, folder, tmp_path):  # noqa: ARG001  its processes end before the server
    """Starts a trainer, which runs until it is ended; its process, its watchdog and its log."""
    started = []

    def trainer(job=None):
        file = job or saved_job(folder, tmp_path, len(started))
        log, watchdog = ProcessLog("trainer", (tmp_path / f"{len(started)}.log").open("w+b")), Watchdog()
        request = StartRequest.here("trainer", file, restarted=False)
        process = start_server().start(request, log.fileno(), watchdog.handle)
        started.append((process, watchdog, log))
        return started[-1]

    yield trainer
    for process, watchdog, log in started:
        process.close()
        watchdog.close()
        log.close()


@pytest.fixture
def node():
    """A process that a shared server ends with."""
    process = subprocess.Popen(["sleep", "600"])
    yield process
    process.kill()
    process.wait()


def saved_job(folder, tmp_path, number):
    """The file of a job with an endpoint of its own: a second trainer at the same one would end."""
    (folder / str(number)).mkdir()
    (tmp_path / str(number)).mkdir()
    return Job(endpoint=str(folder / str(number))).save(tmp_path / str(number))


def opened(pid):
    """What the descriptors of a process lead to."""
    places = {}
    for name in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # it opens and closes files meanwhile
            places[name.name] = str(name.readlink())
    return places


def sockets(pid):
    """The sockets and pipes that a process has open."""
    return [place for place in opened(pid).values() if place.startswith(("socket:", "pipe:"))]


def prefixed(monkeypatch, statements):
    """Let the next servers run other statements first."""
    command = module.python_command
    monkeypatch.setattr(module, "python_command", lambda program: command(statements + program))


def test_a_process_is_a_fork_of_the_server_with_a_title_a_session_and_a_folder_of_its_own(server, start, until):
    started, watchdog, _ = start()
    until(lambda: watchdog.turns > 0)
    process = psutil.Process(started.pid)
    assert process.ppid() == server.pid
    assert " ".join(process.cmdline()) == "catstream trainer"
    assert process.name() == "trainer"
    assert os.getsid(process.pid) == process.pid
    assert " ".join(psutil.Process(server.pid).cmdline()) == "catstream start server"


def test_a_process_has_its_own_descriptors_and_none_of_the_server(start, until):
    process, watchdog, log = start()
    until(lambda: watchdog.turns > 0)
    found = opened(process.pid)
    assert found["0"] == found["1"] == "/dev/null"
    assert found["2"] == str(Path(f"/proc/self/fd/{log.fileno()}").readlink())
    of_the_server = set(sockets(psutil.Process(process.pid).ppid()))
    assert not of_the_server & set(sockets(process.pid))


def test_the_server_has_one_thread(server, start):
    start()[0].pid  # noqa: B018  the server has imported what a trainer needs
    assert psutil.Process(server.pid).num_threads() == 1


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGKILL, -signal.SIGKILL)])
def test_how_a_process_has_ended_is_known(start, until, number, code):
    process, watchdog, _ = start()
    until(lambda: watchdog.turns > 0)
    assert process.poll() is None
    process.send_signal(number)
    assert process.wait(60)
    assert process.poll() == code


def test_a_process_that_is_ended_before_it_was_started_does_not_run(server, start, until):
    os.kill(server.pid, signal.SIGSTOP)
    process, watchdog, _ = start()
    process.send_signal(signal.SIGTERM)
    os.kill(server.pid, signal.SIGCONT)
    assert process.poll() == -signal.SIGTERM
    assert start()[0].pid  # requests are processed in order
    until(lambda: len(psutil.Process(server.pid).children()) == 1)
    assert watchdog.turns == 0


def test_a_server_that_a_signal_has_stopped_is_killed_if_a_process_waits_for_its_start(server, start):
    os.kill(server.pid, signal.SIGSTOP)
    process, _, _ = start()
    assert process.pid == 0
    assert process.poll() == -signal.SIGKILL
    assert psutil.Process(start()[0].pid).ppid() == start_server().pid != server.pid


def test_an_error_before_the_first_turn_is_in_the_log_of_the_process(start, tmp_path):
    (tmp_path / "job").write_text("not a job")
    process, _, log = start(tmp_path / "job")
    assert process.wait(60)
    assert process.poll() == 2
    assert "job" in log.last_line()


def test_the_processes_end_with_the_server_and_the_next_one_is_started_by_a_new_server(server, start, until):
    process, watchdog, _ = start()
    until(lambda: watchdog.turns > 0)
    running = psutil.Process(process.pid)
    os.kill(server.pid, signal.SIGKILL)
    assert process.wait(60)
    assert process.poll() == -signal.SIGKILL
    until(lambda: not running.is_running())
    again, watchdog, _ = start()
    until(lambda: watchdog.turns > 0)
    assert psutil.Process(again.pid).ppid() == start_server().pid != server.pid


@pytest.mark.parametrize("shared", [False, True])
def test_a_start_right_after_a_server_was_killed_does_not_reach_that_server(server, start, node, monkeypatch, shared):
    """Its sockets are open until the kernel has closed them all."""
    if shared:
        server.close()
        monkeypatch.setattr(module, "_shared_with", node.pid)
    for _ in range(3):
        process, killed = start()[0], start_server().pid
        assert process.pid
        os.kill(killed, signal.SIGKILL)
        assert process.wait(60)
        assert start()[0].pid
        assert start_server().pid != killed


def test_a_process_that_nobody_waits_for_any_more_is_killed(start, until):
    process, watchdog, _ = start()
    until(lambda: watchdog.turns > 0)
    running = psutil.Process(process.pid)
    process._answers.shutdown(socket.SHUT_RDWR)
    until(lambda: not running.is_running())


def test_a_process_has_the_environment_and_the_folder_that_its_program_has_now(
    server, start, monkeypatch, tmp_path, until
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert start_server() is server
    monkeypatch.chdir(tmp_path)
    started, watchdog, _ = start()
    until(lambda: watchdog.turns > 0)
    process = psutil.Process(started.pid)
    assert process.cwd() == str(tmp_path)


def test_a_variable_that_libraries_read_needs_another_server_and_an_idle_one_ends(server, start, monkeypatch):
    start()[0].close()
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    other = start_server()
    assert other.pid != server.pid
    assert not psutil.pid_exists(server.pid)
    assert psutil.Process(start()[0].pid).ppid() == other.pid


def test_a_server_whose_processes_run_is_kept_although_the_environment_has_changed(server, start, monkeypatch):
    process = start()[0]
    assert process.pid
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert start_server().pid != server.pid
    assert process.poll() is None


def test_a_server_with_more_than_one_thread_starts_processes_without_forking_and_says_so_once(
    server, start, monkeypatch, until
):
    prefixed(monkeypatch, "import threading; threading.Thread(target=threading.Event().wait, daemon=True).start(); ")
    server.close()
    for _ in range(2):
        process, watchdog, _ = start()
        until(lambda turns=watchdog: turns.turns > 0)
        assert psutil.Process(process.pid).ppid() == start_server().pid
        process.send_signal(signal.SIGTERM)
        assert process.wait(60)
        assert process.poll() == 0
    (line,) = module.start_server_lines()
    assert "without a fork" in line


def test_processes_of_one_server_have_random_numbers_of_their_own(server, start, monkeypatch):
    numbers = "print(random.random(), numpy.random.random(), file=sys.stderr)"
    prefixed(
        monkeypatch,
        "from catstream.numerics.threads import limit_process; limit_process(); "
        "import numpy, random, sys; from catstream.services import loop; "
        f"loop.run = lambda *_, **__: {numbers} or 0; ",
    )
    server.close()
    drawn = []
    for _ in range(2):
        process, _, log = start()
        assert process.wait(60)
        drawn += log.last_line().split()
    assert len(set(drawn)) == 4


def test_nothing_outlives_a_program_that_is_killed(until):
    program = (
        "import time; from catstream.services.start_server import start_server; "
        "print(start_server().pid, flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as owner:
        server = psutil.Process(int(owner.stdout.readline()))
        owner.kill()
    until(lambda: not server.is_running() or server.status() == psutil.STATUS_ZOMBIE)


def test_a_program_that_has_closed_its_standard_streams_has_a_server_that_runs(tmp_path, folder):
    job, log = Job(endpoint=str(folder)).save(tmp_path), tmp_path / "log"
    program = f"""
import os
os.closerange(0, 3)
from catstream.services.start_server import StartRequest, start_server
from catstream.services.watchdog import Watchdog
server = start_server()
with open({str(log)!r}, "w+b") as log:
    request = StartRequest.here("trainer", {str(job)!r}, restarted=False)
    process = server.start(request, log.fileno(), Watchdog().handle)
    pid = process.pid
    process.close()
os._exit(0 if pid else 1)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_a_copy_of_a_program_that_was_forked_starts_a_server_of_its_own(server):
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


SHARING = """
import sys, time
from catstream.services import start_server as module
from catstream.services.process_log import ProcessLog
from catstream.services.start_server import StartRequest, share_start_server, start_server
from catstream.services.watchdog import Watchdog

share_start_server(int(sys.argv[1]))
log, watchdog = ProcessLog("trainer", open(sys.argv[2] + ".log", "w+b")), Watchdog()
request = StartRequest.here("trainer", sys.argv[2], restarted=False)
process = start_server().start(request, log.fileno(), watchdog.handle)
print(process.pid, flush=True)
time.sleep(600)
"""


@pytest.fixture
def sharing(folder, tmp_path):
    """Starts a program that shares a server with others, and a process of it; both of them."""
    programs = []

    def start(program):
        words = [sys.executable, "-c", SHARING, str(program), str(saved_job(folder, tmp_path, len(programs)))]
        variables = dict(sorted(os.environ.items(), reverse=bool(len(programs) % 2)))  # their order does not matter
        programs.append(subprocess.Popen(words, env=variables, stdout=subprocess.PIPE, text=True))
        return programs[-1], psutil.Process(int(programs[-1].stdout.readline()))

    yield start
    for each in programs:
        each.kill()
        each.communicate()


def has_ended(process):
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def test_programs_share_a_server_that_ends_with_the_process_that_they_name(sharing, node, until):
    first, one = sharing(node.pid)
    second, other = sharing(node.pid)
    server = one.parent()
    assert other.ppid() == server.pid
    assert server.ppid() not in (first.pid, second.pid), "it outlives each of them"
    first.kill()
    until(lambda: has_ended(one))
    assert not has_ended(other)
    third, another = sharing(node.pid)
    assert another.ppid() == server.pid
    node.kill()
    until(lambda: has_ended(server) and has_ended(other) and has_ended(another))
    assert (second.poll(), third.poll()) == (None, None)


def test_a_shared_server_that_a_signal_has_stopped_is_killed_if_a_process_waits_for_its_start(
    server, start, node, monkeypatch, until
):
    server.close()
    monkeypatch.setattr(module, "_shared_with", node.pid)
    shared = psutil.Process(start()[0].pid).parent()
    assert shared.pid == start_server().pid != node.pid
    shared.suspend()
    process, _, _ = start()
    assert process.pid == 0
    assert process.poll() == -signal.SIGKILL
    until(lambda: has_ended(shared))
    assert psutil.Process(start()[0].pid).ppid() == start_server().pid != shared.pid


def test_a_shared_server_whose_process_has_ended_before_it_started_ends_too():
    with subprocess.Popen(["true"]) as node:
        node.wait()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind("")  # any free name
        server = module._start(listener, node.pid, subprocess.DEVNULL)
    assert server.wait(60) == 0


def test_a_start_server_of_another_user_is_not_used(node, monkeypatch):
    """This process takes itself for one of another user than the server that it reaches."""
    monkeypatch.setattr(module, "_servers", [])
    monkeypatch.setattr(module.os, "getuid", lambda: 12345)
    monkeypatch.setattr(module, "_shared_with", node.pid)
    with pytest.raises(PermissionError, match="of another user"):
        module._connected(node.pid)
    own = start_server()
    assert psutil.Process(own.pid).ppid() == os.getpid()
    own.close()


def test_a_shared_server_counts_as_ending_before_its_sockets_close(server, node, monkeypatch):
    """Otherwise the second attempt of a start reaches the same server as the first one."""
    server.close()
    monkeypatch.setattr(module, "_shared_with", node.pid)
    shared = start_server()
    node.kill()
    shared._requests.settimeout(60)
    assert shared._requests.recv(1) == b""
    assert not shared.is_usable


@pytest.mark.parametrize("reaped", [True, False])
def test_a_program_whose_partner_has_ended_has_a_server_of_its_own(reaped, sharing, until):
    with subprocess.Popen(["true"]) as node:
        until(lambda: has_ended(psutil.Process(node.pid)))
        if reaped:
            node.wait()
        program, process = sharing(node.pid)
        assert process.parent().ppid() == program.pid


ENDS = """
import atexit, ctypes, os
from catstream.services import loop, start_server

loop.run = lambda *_, **__: 3
atexit.register(print, "the rest is transmitted", flush=True)
late = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_void_p)(lambda *_: None)
ctypes.CDLL(None).on_exit(late, None)
start_server.run_started("detector", "job", False, os.getppid(), 0)
"""


def test_a_process_ends_normally_although_c_code_calls_python_after_the_end_as_the_thread_of_a_hanging_source_does():
    ended = subprocess.run([sys.executable, "-P", "-c", ENDS], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (3, "the rest is transmitted\n")
