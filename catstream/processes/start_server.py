"""The start server: a process that imports the modules of the processes of a pipeline once, and forks the processes.

The imports take half a second, a fork some milliseconds. The first pipeline of a program starts the server, which all
pipelines of the program share. The server ends with the program, even after a crash.

    program                      start server                     detector, compressor, trainer
       │ ─── request ─────────────> │ ─────────────────────── fork ─> │
       │ <── process id ─────────── │                                 │
       │ <── exit code ──────────── │ <─────────────────────── exit ─ │

A request is a packet of JSON on a Unix socket, with the file descriptors of the log, of the shared memory, and of a
socket for two answers: the process id, then the exit code (or minus the number of a signal). The server has one thread,
because a fork copies only the calling thread. If the server dies, the kernel kills its processes, and a new server
restarts them.
"""

from __future__ import annotations

import atexit
import fcntl
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path

from catstream.base.forks import after_fork
from catstream.base.threads import ONE_THREAD
from catstream.errors import ServiceError

#: The processes that a server can start, in the order in which a pipeline starts and ends them.
NAMES = ("detector", "compressor", "trainer")

_LOOK_SECONDS = 0.01  # polling interval while a process starts or ends
_EXIT_SECONDS = 1.0  # timeout for a server that has closed its sockets to end
_LONGEST = 1 << 16  # bytes of a request
_MOST_DESCRIPTORS = 1 << 16  # upper bound for a server; the limit of open files may be 10^9, too many to close
#: glibc's thresholds for returning freed memory and for mapping arrays separately, at its own dynamic maximum. With
#: lower ones, the kernel clears new pages for each sample and checkpoint: 5 % of a compressor's time. Each process
#: releases its memory once a second. With one arena, threads reuse each other's freed memory.
_MALLOC = {"MALLOC_TRIM_THRESHOLD_": str(64 << 20), "MALLOC_MMAP_THRESHOLD_": str(32 << 20), "MALLOC_ARENA_MAX": "1"}


class StartedProcess:
    """A process that the server starts or has started; `answers` is the socket for the server's answers."""

    def __init__(self, server: subprocess.Popen[bytes], answers: socket.socket) -> None:
        self._server, self._answers, self._lock = server, answers, threading.Lock()
        self._pid = 0
        self._code: int | None = None
        self.lost = False  #: whether the server ended before the process

    @property
    def server_code(self) -> int | None:
        """Exit code of the server, None while it runs; waits for a server that is ending (`lost`)."""
        with suppress(subprocess.TimeoutExpired):
            return self._server.wait(_EXIT_SECONDS if self.lost else 0)
        return None

    @property
    def pid(self) -> int:
        """Process id, 0 if the process has ended; waits until the server has started it."""
        while not self._pid and self._code is None:
            self._receive(_LOOK_SECONDS)
        return self._pid if self.poll() is None else 0

    def poll(self) -> int | None:
        """Exit code, or minus the number of the signal; None while the process runs or is being started."""
        while self._code is None and self._receive(0):
            pass
        return self._code

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, unless it has ended."""
        if pid := self.pid:
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def _receive(self, seconds: float) -> bool:
        """Receive the next answer; returns False if none arrives within `seconds`."""
        with self._lock:  # several threads may call this
            if self._code is not None:  # another thread has received the last answer, and may have closed the socket
                return False
            self._answers.settimeout(seconds)
            try:
                data = self._answers.recv(_LONGEST)
            except (BlockingIOError, TimeoutError):
                return False
            except ConnectionError:
                data = b""
            if not data:  # the server has ended, and the kernel kills the process
                self._code, self.lost = -signal.SIGKILL, True
            elif self._pid:
                self._code = int(data)
            else:
                self._pid = int(data)
            return True

    def close(self) -> None:
        """Kill the process if it runs, and wait until it has ended."""
        self.send_signal(signal.SIGKILL)
        while self.poll() is None:
            self._receive(_LOOK_SECONDS)
        self._answers.close()


class StartServer:
    """The client of a start server; ServiceError if this program has no Python interpreter."""

    def __init__(self) -> None:
        if getattr(sys, "frozen", False) or not os.access(sys.executable or "", os.X_OK):
            raise ServiceError("a frozen program has no Python interpreter for its processes: run it with python")
        self._requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # If the program has closed its standard output, the socket may have descriptor 1.
        passed = fcntl.fcntl(theirs, fcntl.F_DUPFD_CLOEXEC, 3)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "catstream.processes.start_server", str(passed), str(os.getpid())],
                env=ONE_THREAD | os.environ | _MALLOC,
                cwd="/",  # relative entries of PYTHONPATH must not refer to the program's current folder
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # otherwise a reader of the program's output would wait for the server's end
                pass_fds=[passed],
                start_new_session=True,  # only the program receives Ctrl-C, and ends its processes in order
            )
        os.close(passed)
        self.pid = self._process.pid

    def runs(self) -> bool:
        """Return True while the server runs; ServiceError if it has ended with an error."""
        if (code := self._process.poll()) is not None and code > 0:
            raise ServiceError(
                f"{sys.executable} did not start the processes of a pipeline (exit code {code}): its error is above"
            )
        return code is None

    def start(self, name: str, job: Path, log: int, memory: int, *, restarted: bool) -> StartedProcess:
        """Request one of the processes `NAMES`, with descriptors of its log and its memory, without waiting."""
        try:
            folder = str(Path.cwd())
        except FileNotFoundError:  # the current folder was removed
            folder = "/"
        request = {"name": name, "job": str(job), "restarted": restarted, "folder": folder}
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, suppress(ConnectionError):  # the server has just ended: `StartedProcess` detects it
            socket.send_fds(self._requests, [json.dumps(request).encode()], [log, memory, theirs.fileno()])
        return StartedProcess(self._process, ours)

    def close(self) -> None:
        """End the server and its processes."""
        self._requests.close()
        self._process.kill()  # a long import would delay an orderly end
        self._process.wait()


@contextmanager
def starting() -> Iterator[None]:
    """Convert an OSError in a block that starts processes, such as a limit, to a ServiceError with a remedy."""
    try:
        yield
    except OSError as error:
        raise ServiceError(
            f"cannot start the processes of a pipeline ({error.strerror}): end other programs, or raise the limits of "
            "this one (ulimit -a)"
        ) from None


_server: StartServer | None = None
_lock = threading.Lock()


def start_server() -> StartServer:
    """The server of this program, which is started if it is not running."""
    global _server
    with _lock:
        try:
            runs = _server is not None and _server.runs()
        except ServiceError:
            close_start_server()  # the next call starts a new one
            raise
        if _server is None or not runs:
            close_start_server()
            with starting():
                _server = StartServer()
        return _server


@atexit.register
def close_start_server() -> None:
    """End the server of this program, if there is one."""
    global _server
    if _server is not None:
        _server.close()
    _server = None


def _reset_after_fork() -> None:
    """Drop the server of the parent, and the lock, which another thread may have locked."""
    global _lock, _server
    _lock, _server = threading.Lock(), None


after_fork(_reset_after_fork)


def _import(name: str) -> None:
    """Import the module of a process. Errors are ignored: the process imports it again, and reports the error."""
    with suppress(Exception):
        import_module(f"catstream.processes.{name}")


def main(descriptor: int, program: int) -> None:
    """Serve the requests on a socket until the program ends; does not return in the started processes."""
    # Step 1: reset inherited state.
    if sys.stderr is None:  # the program has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        sys.stderr = os.fdopen(2, "w")
    gc.disable()  # imports create no garbage
    from catstream.base.system import name_process
    from catstream.processes.process import reset_process

    reset_process()
    name_process("catstream:start")
    # Step 2: poll the requests, the ends of processes (by a pipe that SIGCHLD writes to), and the end of the program.
    requests = socket.socket(fileno=descriptor)
    has_ended, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(wakes)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    poll = select.poll()
    for readable in (requests.fileno(), has_ended, os.pidfd_open(program)):
        poll.register(readable, select.POLLIN)
    running: dict[int, socket.socket] = {}  # sockets for the answers, by process id
    to_import = [*NAMES]
    while True:
        ready = [readable for readable, _ in poll.poll(0 if to_import else None)]
        if not ready:  # Step 3: while idle, import the modules.
            _import(to_import.pop(0))
        elif has_ended in ready:  # Step 4: report exit codes.
            os.read(has_ended, 4096)
            while running and (ended := os.waitpid(-1, os.WNOHANG))[0]:
                with running.pop(ended[0]) as answers, suppress(OSError):  # the client may have gone away
                    answers.send(b"%d" % os.waitstatus_to_exitcode(ended[1]))
        elif requests.fileno() in ready:  # Step 5: fork a process, and report its id.
            data, descriptors, _, _ = socket.recv_fds(requests, _LONGEST, 3)
            if not data:
                return
            log, memory, answer_to = descriptors
            request = json.loads(data)
            _import(request["name"])
            gc.freeze()  # exclude shared memory from later collections, which would copy its pages
            parent = os.getpid()
            if not (pid := os.fork()):
                _run(request, parent, log, memory)
            os.close(log)
            os.close(memory)
            running[pid] = socket.socket(fileno=answer_to)
            with suppress(OSError):
                running[pid].send(b"%d" % pid)
        else:
            return


def _run(request: dict[str, str], parent: int, log: int, memory: int) -> None:
    """Run a process that was just forked, and exit with its code."""
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.dup2(log, sys.stderr.fileno())
        os.closerange(3, memory)  # close the server's descriptors
        os.closerange(memory + 1, _MOST_DESCRIPTORS)
        with suppress(OSError):  # the folder was removed
            os.chdir(request["folder"])
        gc.enable()
        from catstream.processes.process import run

        code = run(request["name"], Path(request["job"]), parent, memory, restarted=bool(request["restarted"]))
        atexit._run_exitfuncs()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)  # skip finalization, after which the thread of a source that hangs would crash


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]), int(sys.argv[2]))
    except OSError as error:  # a limit of processes or memory
        sys.exit(f"catstream: cannot start a process: {error.strerror}")
