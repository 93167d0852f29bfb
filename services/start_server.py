"""The start server: a process that has imported what the processes of a pipeline need, and forks them.

These imports take a process half a second, and a fork some milliseconds. The first pipeline of a program starts the
server; all pipelines of the program share it, and it ends with the program.

    program                      start server                     detector, compressor, trainer
       │ ─── log, watchdog, ... ──> │ ─────────────────────── fork ─> │
       │ <── process id ─────────── │                                 │
       │ <── exit code ──────────── │ <─────────────────────── exit ─ │

A request is a packet on a Unix socket that only carries descriptors: a file with the request in JSON, the log, the
watchdog, and a socket for the two answers, which is of this process alone. The program does not wait for them: requests
stay in the socket while the server still imports.

The server has one thread: a fork copies only the thread that calls it, and a lock that another one holds would stay
locked in the copy. If a library has started a thread, the server starts each process without forking, and logs that.

The kernel kills these processes when the server ends, and the server ends with its program, however that ended. If the
server is killed, its processes are restarted like any that died, by a new server. A server that a signal has stopped is
killed as soon as one of its processes stands still or waits for its start.

A process that nobody waits for any more is killed: its program has ended, or has closed the socket for the answers.

Several programs can share a server, such as the streams of a fleet on one node (`share_start_server`). It ends with a
process that outlives them. A program finds the server by the name of its socket, and both check that the other is of
the same user.
"""

from __future__ import annotations

import atexit
import errno
import fcntl
import gc
import hashlib
import json
import logging
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import BinaryIO, cast
from weakref import WeakSet

from catstream.errors import ServiceError
from catstream.numerics.threads import limit_process
from catstream.services.process_log import ProcessLog
from catstream.services.process_title import is_ending, is_suspended, process_fields, set_process_title
from catstream.services.start import environment, import_path, python_command
from catstream.services.timing import KILLED_SECONDS, LOOK_SECONDS, SHARED_SECONDS, STOPPED_SECONDS

#: The processes that a server can start, in the order in which a pipeline starts and ends them.
NAMES = ("detector", "compressor", "trainer")

_ANSWER = struct.Struct("=i")  # the process id, 0 if it could not be started; the exit code, or minus the signal
#: Beginnings of the environment variables that libraries read when they are imported.
_READ_BY_IMPORTS = ("LD_", "MKL_", "NPY_", "NUMBA_", "OMP_", "OPENBLAS_", "OPENCV_", "PYTHON", "XDG_CACHE_HOME")
#: The limits to which glibc raises its own: of freed memory that it keeps, and of arrays that it does not map alone.
#: With lower ones, the kernel clears new pages for each sample and checkpoint: a twentieth of a compressor's time.
_MALLOC = {"MALLOC_TRIM_THRESHOLD_": str(64 << 20), "MALLOC_MMAP_THRESHOLD_": str(32 << 20)}
_BEGAN = 22  # field of a process: the moment at which it began
_CREDENTIALS = struct.Struct("=iii")  # process, user and group of the other end of a Unix socket
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class StartRequest:
    """A process to start.

    name         one of `NAMES`
    job          file of its job
    restarted    whether it continues the work of a process that died
    folder       its current folder
    environment  its environment variables
    """

    name: str
    job: str
    restarted: bool
    folder: str
    environment: dict[str, str]

    @classmethod
    def here(cls, name: str, job: Path, *, restarted: bool) -> StartRequest:
        """With the folder and the environment of this process."""
        try:
            folder = str(Path.cwd())
        except FileNotFoundError:  # it was removed
            folder = "/"
        return cls(name, str(job), restarted, folder, environment())


class StartedProcess:
    """A process that a server starts or has started; used like a `subprocess.Popen`.

    Parameters
    ----------
    answers : socket on which the server sends the process id, and later the exit code
    server : process id of the server
    """

    def __init__(self, answers: socket.socket, server: int) -> None:
        self._answers, self._server = answers, server
        self._pid: int | None = None
        self._code: int | None = None

    @property
    def pid(self) -> int:
        """Process id; waits until the server has started the process. 0 if it could not be started."""
        while self._pid is None and self._code is None:
            if not self._receive(STOPPED_SECONDS) and self.is_suspended:
                self.kill()
        return self._pid or 0

    def poll(self) -> int | None:
        """Exit code, negative for the signal that ended the process; None while it runs or is being started."""
        while self._code is None and self._receive(0):
            pass
        return self._code

    def wait(self, seconds: float) -> bool:
        """Wait at most this long for the end of the process; returns whether it has ended."""
        while self._code is None and self._receive(seconds):
            pass
        return self._code is not None

    @property
    def is_suspended(self) -> bool:
        """Whether a signal such as SIGSTOP has stopped the process, or its server, which then reports no end of it."""
        return is_suspended(self._server) or bool(self._pid and is_suspended(self._pid))

    def kill(self) -> None:
        """Kill the process if it runs; its server too, with all processes, if a signal has stopped that."""
        if self.poll() is None and is_suspended(self._server):
            with suppress(ProcessLookupError):
                os.kill(self._server, signal.SIGKILL)
        self.send_signal(signal.SIGKILL)

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, unless it has ended. One that was not started yet is not started any more."""
        if self.poll() is not None:
            return
        if self._pid is None:  # nobody will receive the server's answer: it kills the process at once
            self._answers.close()
            self._code = -number
        elif self._pid:
            with suppress(ProcessLookupError):
                os.kill(self._pid, number)

    def close(self) -> None:
        """Kill the process if it runs, and wait until it has ended."""
        self.kill()
        self.wait(KILLED_SECONDS)
        self._answers.close()

    def _receive(self, seconds: float) -> bool:
        """Receive the next answer; returns whether one arrived in time."""
        self._answers.settimeout(seconds)
        try:
            data = self._answers.recv(_ANSWER.size)
        except (BlockingIOError, TimeoutError):
            return False
        except ConnectionError:
            data = b""
        if not data:  # the server has ended, and the kernel kills the process
            self._code = -signal.SIGKILL
        elif self._pid is None:
            self._pid = int(_ANSWER.unpack(data)[0])
        else:
            self._code = int(_ANSWER.unpack(data)[0])
        return True


class StartServer:
    """A start server, as its program sees it.

    Parameters
    ----------
    shared_with : process id of the process with which a shared server ends; None for a server of this program alone

    Attributes
    ----------
    pid : its process id
    log : what it logged: that kernels are compiled, that it cannot fork; a shared one logs to the standard error of the
        program that has started it

    Raises
    ------
    OSError
        If a shared server cannot be used.
    """

    def __init__(self, shared_with: int | None = None) -> None:
        self._program, self._imports = os.getpid(), _imports()
        self._processes: WeakSet[StartedProcess] = WeakSet()
        self._process: subprocess.Popen[bytes] | None = None
        if shared_with is not None:
            self._requests = _connected(shared_with)
            self.pid = _other_end(self._requests)[0]
        self.log = ProcessLog("start server", cast(BinaryIO, tempfile.TemporaryFile()))  # noqa: SIM115
        if shared_with is None:
            self._requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._process = _start(theirs, self._program, self.log.fileno())
            self.pid = self._process.pid

    @property
    def is_owned(self) -> bool:
        """Whether this process has started it; a copy of this process that was forked has not."""
        return self._program == os.getpid()

    @property
    def is_usable(self) -> bool:
        """Whether it runs, and has imported what this program would import now."""
        return self.is_owned and self._imports == _imports() and not is_ending(self.pid)

    @property
    def is_idle(self) -> bool:
        """Whether all its processes have ended."""
        return all(process.poll() is not None for process in self._processes)

    def start(self, request: StartRequest, log: int, watchdog: int) -> StartedProcess:
        """Request a process, and return without waiting for its start.

        Parameters
        ----------
        log : descriptor of the file that becomes its standard error
        watchdog : descriptor of the memory of its watchdog

        Raises
        ------
        OSError
            If the server has ended.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, tempfile.TemporaryFile() as file:
            file.write(json.dumps(asdict(request)).encode())
            file.seek(0)
            try:
                socket.send_fds(self._requests, [b"start"], [file.fileno(), log, watchdog, theirs.fileno()])
            except OSError:
                ours.close()
                raise
        process = StartedProcess(ours, self.pid)
        self._processes.add(process)
        return process

    def close(self) -> None:
        """End the server, and its processes with it; a shared server only ends the processes of this program."""
        self._requests.close()
        if self._process is not None:
            self._process.kill()  # it may be in a long import
            self._process.wait()
        self.log.close()


def _imports() -> tuple[list[str], dict[str, str]]:
    """The import path and the environment variables on which the imports of a process depend."""
    return import_path(), {name: value for name, value in environment().items() if name.startswith(_READ_BY_IMPORTS)}


def _start(requests: socket.socket, program: int, log: int | None, first: str = "") -> subprocess.Popen[bytes]:
    """Start the process of a server, which runs the statement `first` before anything else."""
    # If the program has closed its standard output, the socket may have its number, where the server opens a file.
    passed = fcntl.fcntl(requests, fcntl.F_DUPFD_CLOEXEC, 3)
    try:
        main = f"{first}from catstream.services.start_server import main; main({passed}, {program})"
        return _run(python_command(main), passed, log, "/", _MALLOC | environment())
    finally:
        os.close(passed)


def _run(
    command: list[str], passed: int, log: int | None, folder: str, variables: dict[str, str]
) -> subprocess.Popen[bytes]:
    """Run a command that inherits one descriptor and the log."""
    return subprocess.Popen(
        command,
        env=variables,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,  # a reader of the program's output would wait for the end of the command
        stderr=log,
        pass_fds=[passed],
        start_new_session=True,  # Ctrl-C is for the program, which then ends its processes in order
    )


def _connected(program: int) -> socket.socket:
    """A connection to the server that ends with a program and has imported what this process would; it may be new."""
    os.close(os.pidfd_open(program))  # the server will see its end
    if is_ending(program):  # nobody has waited for it yet
        raise ProcessLookupError(errno.ESRCH, "the program has ended")
    began = process_fields(program)[_BEGAN]
    key = json.dumps([os.getuid(), program, began, _imports()], sort_keys=True)  # variables have no order
    name = f"\0catstream-start-{hashlib.sha256(key.encode()).hexdigest()}"  # the kernel removes it with the server
    deadline = time.monotonic() + SHARED_SECONDS
    while True:
        requests = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            requests.connect(name)
            server, user = _other_end(requests)
            if user != os.getuid():
                raise PermissionError(errno.EPERM, "the start server is of another user")
            if is_ending(server):  # it was killed just now, and its socket is open a little longer
                raise ConnectionRefusedError(errno.ECONNREFUSED, "the start server is ending")
            return requests
        except ConnectionRefusedError:  # nobody listens, or not yet
            requests.close()
            if time.monotonic() > deadline:
                raise
        except OSError:
            requests.close()
            raise
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            try:
                listener.bind(name)
            except OSError:  # it is bound for a server that will listen
                time.sleep(LOOK_SECONDS)
                continue
            # The server is no child of this process, whose end may be that of all its children.
            _start(listener, program, None, "import os; os.fork() and os._exit(0); ").wait()


def _other_end(channel: socket.socket) -> tuple[int, int]:
    """The process and the user at the other end of a Unix socket: of a server, those that listen."""
    process, user, _ = _CREDENTIALS.unpack(channel.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return process, user


_servers: list[StartServer] = []
_shared_with: int | None = None
_lock = threading.Lock()


def share_start_server(program: int) -> None:
    """Let this process share one start server with all others that name the same program; it ends with that program."""
    global _shared_with
    _shared_with = program


def start_server() -> StartServer:
    """The server of this program; a new one if there is none, or if the program would import something else now."""
    with _lock:
        for server in [*_servers]:
            if server.is_owned and not server.is_usable and server.is_idle:
                server.close()
                _servers.remove(server)
        usable = next((server for server in _servers if server.is_usable), None)
        if usable is None:
            try:
                usable = StartServer(_shared_with)
            except OSError as error:  # an old kernel, or a stranger
                _log.warning("this program has a start server of its own: %s", error)
                usable = StartServer()
            _servers.append(usable)
        return usable


def start_server_lines() -> list[str]:
    """The lines that the start servers of this program have logged since the last call."""
    return [line for server in [*_servers] if server.is_owned for line in server.log.new_lines()]


@atexit.register
def _close_all() -> None:
    for server in _servers:
        if server.is_owned:
            server.close()


def _unlock() -> None:
    """Replace the lock in a copy of this process, where another thread of the original may have held it."""
    global _lock
    _lock = threading.Lock()


os.register_at_fork(after_in_child=_unlock)


class _Server:
    """The server itself.

    Parameters
    ----------
    requests : socket of the requests, which the program closes when it ends; for a shared server, one with a name
    program : process id of the program with which it ends
    """

    def __init__(self, requests: socket.socket, program: int) -> None:
        self._listener = requests if requests.getsockname() else None
        if self._listener is not None:
            self._listener.listen()  # by the server itself: so a program that connects knows its process id
        self._clients = {} if self._listener is not None else {requests.fileno(): requests}
        self._processes: dict[int, socket.socket] = {}  # sockets for the answers about those that run, by their ids
        self._ended, ended = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(ended)
        signal.signal(signal.SIGCHLD, lambda *_: None)  # wakes `poll` up
        self._descriptors = [self._ended, ended]
        self._poll = select.poll()
        self._poll.register(requests, select.POLLIN)
        self._poll.register(self._ended, select.POLLIN)
        try:
            self._descriptors.append(program_end := os.pidfd_open(program))
            self._poll.register(program_end, select.POLLIN)
        except OSError:  # a kernel before 5.3: then only the end of the socket shows the end of the program
            if self._listener is not None:  # it has ended meanwhile
                raise SystemExit(0) from None
        self._logged = False

    def serve(self) -> tuple[StartRequest, int] | None:
        """Start processes until the program ends.

        Returns
        -------
        None in the server; in each process that it has forked, its request and the descriptor of its watchdog
        """
        to_import = list(NAMES)
        while True:
            ready = [descriptor for descriptor, _ in self._poll.poll(0 if to_import else None)]
            if self._ended in ready:
                os.read(self._ended, 4096)
                self._reap()
            elif unwanted := next((pid for pid, each in self._processes.items() if each.fileno() in ready), None):
                os.kill(unwanted, signal.SIGKILL)
                self._poll.unregister(self._processes[unwanted])
            elif client := next((self._clients[each] for each in ready if each in self._clients), None):
                try:
                    data, descriptors, _, _ = socket.recv_fds(client, 16, 4)
                except ConnectionError:
                    data, descriptors = b"", []
                if not data:
                    if self._listener is None:
                        return None
                    self._poll.unregister(client)
                    del self._clients[client.fileno()]
                    client.close()
                    continue
                file, log, watchdog, answers = descriptors
                with os.fdopen(file, "rb") as content:
                    request = StartRequest(**json.loads(content.read()))
                if request.name in to_import:
                    to_import.remove(request.name)
                    _import(request.name)
                if self._start(request, log, watchdog, socket.socket(fileno=answers)):
                    return request, watchdog
            elif self._listener is not None and self._listener.fileno() in ready:
                self._accept(self._listener)
            elif ready:
                return None
            else:
                _import(to_import.pop(0))

    def _accept(self, listener: socket.socket) -> None:
        """Accept a program that shares this server."""
        client, _ = listener.accept()
        if _other_end(client)[1] != os.getuid():
            client.close()
            return
        self._clients[client.fileno()] = client
        self._poll.register(client, select.POLLIN)

    def _start(self, request: StartRequest, log: int, watchdog: int, answers: socket.socket) -> bool:
        """Start a process, and send its process id; returns whether this is the new process."""
        try:
            pid = os.fork() if self._can_fork() else _spawn(request, log, watchdog)
        except (OSError, ServiceError) as error:
            os.write(log, f"{request.name}: cannot start a process: {error}\n".encode())
            _answer(answers, 0)
            _answer(answers, 1)
            answers.close()
        else:
            if not pid:
                answers.close()
                self._leave(log, request)
                return True
            self._processes[pid] = answers
            self._poll.register(answers, 0)  # only its end is reported: nobody waits for the process any more
            _answer(answers, pid)
        os.close(log)
        os.close(watchdog)
        return False

    def _can_fork(self) -> bool:
        """Whether this process has one thread; if it has more, this is logged once."""
        threads = len(list(Path("/proc/self/task").iterdir()))
        if threads > 1 and not self._logged:
            self._logged = True
            _log.warning("processes start without a fork, and later: a library has started %d threads", threads - 1)
        return threads == 1

    def _leave(self, log: int, request: StartRequest) -> None:
        """Keep nothing of the server in the process that it has forked."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for each in (self._listener, *self._clients.values(), *self._processes.values()):
            if each is not None:
                each.close()
        for descriptor in self._descriptors:
            os.close(descriptor)
        os.setsid()
        os.dup2(log, sys.stderr.fileno())
        os.close(log)
        os.environ.clear()
        os.environ.update(request.environment)
        limit_process()
        tempfile.tempdir = None  # it follows from the environment
        with suppress(OSError):  # it was removed
            os.chdir(request.folder)
        import_module("numpy").random.seed()  # the module `random` does this by itself
        gc.enable()

    def _reap(self) -> None:
        """Send the exit codes of the processes that have ended."""
        while self._processes:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            with self._processes.pop(pid) as answers:
                with suppress(KeyError):  # it was killed, because nobody waits for it
                    self._poll.unregister(answers)
                _answer(answers, os.waitstatus_to_exitcode(status))


def _answer(answers: socket.socket, number: int) -> None:
    """Send an answer, if somebody waits for it."""
    with suppress(OSError):
        answers.send(_ANSWER.pack(number))


def _import(name: str) -> None:
    """Import what a process needs; an error is left to the process, which has a log."""
    with suppress(Exception):
        import_module(f"catstream.services.{name}").prepare()
    gc.freeze()  # a later collection leaves the memory alone that all processes share


def _spawn(request: StartRequest, log: int, watchdog: int) -> int:
    """Start a process without forking; returns its process id."""
    arguments = request.name, request.job, request.restarted, os.getpid(), watchdog
    command = python_command(f"from catstream.services.start_server import run_started; run_started{arguments!r}")
    process = _run(command, watchdog, log, request.folder, request.environment)
    process.returncode = 0  # the server waits for its end as for that of the others
    return process.pid


def main(requests: int, program: int) -> None:
    """Run a start server; in a process that it has forked, run that.

    Parameters
    ----------
    requests : descriptor of the socket of the requests
    program : process id of the program
    """
    limit_process()  # before anything imports numpy
    server = _Server(socket.socket(fileno=requests), program)
    set_process_title("start server")
    logging.basicConfig(format="start server: %(message)s", level=logging.INFO)
    gc.disable()  # nothing of what is imported is garbage
    parent = os.getpid()
    if (forked := server.serve()) is None:
        os._exit(0)  # at once: its sockets are open until it counts as ending
    request, watchdog = forked
    run_started(request.name, request.job, request.restarted, parent, watchdog)


def run_started(name: str, job: str, restarted: bool, parent: int, watchdog: int) -> None:
    """Run a process that the server with this process id has started, and exit with its code."""
    limit_process()  # before anything imports numpy
    from catstream.services.loop import run

    code = run(name, Path(job), parent, watchdog, restarted=restarted)
    atexit._run_exitfuncs()
    os._exit(code)  # without the end of the interpreter, after which the thread of a source that hangs would crash
