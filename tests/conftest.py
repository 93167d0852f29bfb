"""Fixtures shared by all tests. Fixtures of a single folder are in its own conftest.py.

    data         rng, image, texture, scene: arrays; demo_video, walk, endless: files
    endpoints    folder, endpoint, tcp, keys, disk: sockets, files and keys of one test
    peers        commanded, managing: a thread that answers as a detector, or as the registry of a fleet;
                 camera, walker: an HTTP server in this process
    the command  said, succeed, fail: in this process; catstream, program: in a process of its own, which is killed
                 after the test; alive: whether a process runs
    time         until, turning: wait for a condition. No test depends on a duration

Only `catstream`, `program` and a `catstream.Pipeline` in a test start processes. Two fixtures apply to all tests:
`own_folders` hides other pipelines of this user, and `one_core` makes BLAS add in the same order as in a pipeline.
Fixtures have the scope "session" if they are functions without a state, or if their files take seconds to make.
"""

import fcntl
import io
import logging
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, redirect_stderr, redirect_stdout, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest import mock

import cv2
import hypothesis
import numpy as np
import psutil
import pytest
import scipy.linalg  # noqa: F401  brings a BLAS of its own, to be limited too

from catstream.base.box import Box
from catstream.base.threads import one_thread
from catstream.cli import main
from catstream.cli.common import INTERRUPTS
from catstream.fleet.registry import RegistryServer
from catstream.video.rendered import render, write
from catstream.video.source import open_source
from catstream.wire.channels import CHANNELS, CONTROL
from catstream.wire.commands import Responder
from catstream.wire.endpoint import Endpoint
from catstream.wire.keys import allow, create
from catstream.wire.messages import Answer, Command

# No time is a pass mark, and each run has the same examples.
hypothesis.settings.register_profile(
    "catstream", deadline=None, derandomize=True, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("catstream")

# It is ignored if the tests run in the background of a script, and so it would be by the processes of the tests.
signal.signal(signal.SIGINT, signal.default_int_handler)

#: Which of the processes that share the tests (pytest-xdist) this is, and of how many.
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """Twice as many as there are cores: many tests wait, for the processes that they started."""
    return min(2 * len(os.sched_getaffinity(0)), 8)


@pytest.fixture(scope="session", autouse=True)
def own_folders(tmp_path_factory):
    """Set the folders for sockets, temporary files and states: no other pipeline of this user is found there."""
    tmp_path_factory.getbasetemp()  # remains after the tests
    with tempfile.TemporaryDirectory(prefix="cs-") as folder, pytest.MonkeyPatch.context() as patch:
        for name, variable in (("run", "XDG_RUNTIME_DIR"), ("tmp", "TMPDIR"), ("state", "XDG_STATE_HOME")):
            (Path(folder) / name).mkdir(mode=0o700)
            patch.setenv(variable, str(Path(folder) / name))
        patch.setattr(tempfile, "tempdir", os.environ["TMPDIR"])  # read now: a test may change the variable
        yield


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """Returns the folder of a name, which a function fills once for all workers."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def filled(name, fill):
        folder, done = shared / name, shared / f"{name}.done"
        with (shared / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                folder.mkdir(exist_ok=True)
                fill(folder)
                done.touch()
        return folder

    return filled


@pytest.fixture(scope="session")
def demo_video(once):
    """Renders the first frames of the demo video, once for all workers: its path, and the object's boxes."""

    def rendered(frames):
        folder = once(f"demo-{frames}", lambda folder: write(folder, frames, (320, 240)))
        boxes = np.loadtxt(folder / "groundtruth_rect.txt", delimiter=",")
        return folder / "demo.mp4", [Box(*box) for box in boxes.tolist()]

    return rendered


@pytest.fixture
def endless(demo_video, tmp_path):
    """A folder with 5000 images of the same frame: no run reaches its end."""
    folder = tmp_path / "endless"
    folder.mkdir()
    with open_source(demo_video(32)[0]) as source:
        cv2.imwrite(str(folder / "00000.png"), next(source).image)
    for number in range(1, 5000):
        (folder / f"{number:05d}.png").hardlink_to(folder / "00000.png")
    return str(folder)


@pytest.fixture(scope="session")
def walk(tmp_path_factory):
    """A sequence folder in the layout of OTB: 12 frames, the object absent in frames 5 to 7."""
    folder = tmp_path_factory.mktemp("sets") / "walk"
    (folder / "img").mkdir(parents=True)
    lines = []
    for number, (image, box) in enumerate(render(12, (160, 120))):
        assert box is not None
        cv2.imwrite(str(folder / "img" / f"{number + 1:04d}.png"), image)
        lines.append("nan,nan,nan,nan" if 5 <= number < 8 else str(box))
    (folder / "groundtruth_rect.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="session", autouse=True)
def one_core():
    """Limit BLAS to one thread, as in a pipeline: with more, the last bits of sums differ."""
    with one_thread():
        yield


@pytest.fixture
def rng():
    """Random numbers, the same in every run."""
    return np.random.default_rng(20260101)


@pytest.fixture
def image(rng):
    """Noise of 240 x 200 pixels."""
    return rng.integers(0, 256, (200, 240, 3), np.uint8)


@pytest.fixture
def texture():
    """A function that paints coloured blotches: uint8 (height, width, 3), each blotch about `cell` pixels wide."""
    rng = np.random.default_rng(11)

    def paint(height, width, cell):
        coarse = rng.integers(0, 256, (height // cell + 1, width // cell + 1, 3), np.uint8)
        return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)

    return paint


@pytest.fixture
def scene(texture):
    """A function that draws a frame with the object at (x, y), a share of it covered from the left, or without it."""
    background, thing, cover = texture(240, 320, 20), texture(40, 48, 8), texture(40, 48, 4)

    def draw(at=None, covered=0.0):
        frame = background.copy()
        if at is not None:
            frame[at[1] : at[1] + 40, at[0] : at[0] + 48] = thing
            edge = round(48 * covered)
            frame[at[1] : at[1] + 40, at[0] : at[0] + edge] = cover[:, :edge]
        return frame

    return draw


@pytest.fixture
def folder():
    """A private folder with a name that is short enough for sockets."""
    with tempfile.TemporaryDirectory(prefix="catstream-") as path:  # its notes are found
        yield Path(path)


@pytest.fixture
def endpoint(folder):
    """The endpoint of a pipeline in `folder`."""
    return Endpoint.parse(str(folder))


@pytest.fixture
def keys(folder):
    """A folder of keys; next to it are the keys of a client, anna, who may watch."""
    create(folder / "keys")
    allow(folder / "keys", "anna", "watch", output=folder / "anna")
    return folder / "keys"


@pytest.fixture
def tcp():
    """A tcp endpoint: as many free ports in a row as the channels take."""
    ports = max(channel.port + len(channel.senders) for channel in CHANNELS.values())
    own = range(20000 + 12000 * WORKER // WORKERS, 20000 + 12000 * (WORKER + 1) // WORKERS - ports, ports)
    for first in random.sample(own, min(50, len(own))):
        with ExitStack() as stack:
            try:
                for port in range(first, first + ports):
                    stack.enter_context(socket.socket()).bind(("127.0.0.1", port))
            except OSError:
                continue
        return f"tcp://127.0.0.1:{first}"
    raise AssertionError("no free ports on this machine")


@pytest.fixture(scope="session")
def until():
    """Waits until a condition is true, and returns its value; fails after five minutes."""

    def wait(condition, turn=lambda: time.sleep(0.01)):
        deadline = time.monotonic() + 300
        while not (result := condition()):
            assert time.monotonic() < deadline, "the condition did not become true"
            turn()
        return result

    return wait


@pytest.fixture(scope="session")
def alive():
    """A function that returns whether a process runs; a zombie does not."""

    def runs(pid):
        try:
            return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
        except psutil.NoSuchProcess:
            return False

    return runs


@pytest.fixture(scope="session")
def program():
    """The words that start the command `catstream` in a process of its own."""
    return [sys.executable, "-c", "from catstream.cli import main; main()"]


@pytest.fixture
def catstream(program):
    """Starts the command `catstream`; its processes are killed after the test."""
    with ExitStack() as stack:

        def start(*arguments, **options):
            pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
            process = subprocess.Popen([*program, *map(str, arguments)], **pipes | options)
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start


@pytest.fixture(scope="session")
def said():
    """Runs the command in this process, without the time of imports: exit code, output, errors."""

    def run(*arguments, cwd=None, env=None):
        errors = io.StringIO()
        warnings = logging.StreamHandler(errors)
        warnings.setLevel(logging.WARNING)
        with (
            pytest.MonkeyPatch.context() as patch,
            mock.patch.dict(os.environ, env or {}),  # restores the variables that the command sets
            tempfile.TemporaryFile("w+") as output,  # it has a descriptor
            redirect_stdout(output),
            redirect_stderr(errors),
            ExitStack() as stack,
        ):
            logging.getLogger().addHandler(warnings)
            stack.callback(logging.getLogger().removeHandler, warnings)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                stack.callback(signal.signal, number, signal.getsignal(number))
            patch.setattr(sys, "argv", ["catstream", *map(str, arguments)])
            patch.setattr(tempfile, "tempdir", None)  # it is read from TMPDIR again
            patch.setattr(INTERRUPTS, "exit_code", INTERRUPTS.exit_code)
            if cwd is not None:
                patch.chdir(cwd)
            code = 0
            try:
                main()
            except SystemExit as end:
                code = end.code or 0
            output.seek(0)
            return code, output.read(), errors.getvalue()

    return run


@pytest.fixture(scope="session")
def succeed(said):
    """Runs the command in this process, which must succeed: output, errors."""

    def run(*arguments, **options):
        code, output, errors = said(*arguments, **options)
        assert code == 0, errors
        return output, errors

    return run


@pytest.fixture(scope="session")
def fail(said):
    """Runs the command in this process, which must end with an error of one line, and print no output: this line."""

    def run(*arguments, **options):
        code, output, errors = said(*arguments, **options)
        lines = [line for line in errors.splitlines() if line.startswith(("catstream: ", "Error: "))]
        assert (output, len(lines)) == ("", 1), errors
        assert code == (2 if lines[0].startswith("Error: ") else 1)
        assert "Traceback" not in errors
        return lines[0]

    return run


@contextmanager
def _turning(turn, pause=0.01):
    def run():
        while not over.wait(pause):
            turn()

    over = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(run)
        try:
            yield
        finally:
            over.set()
            running.result(300)


@pytest.fixture
def turning():
    """Calls a function repeatedly in a thread, with a pause in seconds before each call."""
    return _turning


@pytest.fixture
def managing():
    """Serves the registry of a fleet with a status, or with the status that a function returns: its endpoint."""

    @contextmanager
    def manage(status, address="", keys=""):
        current = status if callable(status) else lambda: status
        with closing(RegistryServer(address, keys, current)) as server, _turning(server.serve):
            yield server.endpoint

    return manage


@pytest.fixture
def commanded():
    """A stand-in for the detector, which answers each command; the commands, for example `stop` or `forget ben`."""

    @contextmanager
    def answer(endpoint, answered=lambda command: (True, f"{command.verb} was done")):
        def turn():
            for command in responder.receive_all():
                commands.append(f"{command.verb} {command.object}".strip())
                responder.answer(Answer(command.id, *answered(command)))

        commands = []
        with Responder[Command, Answer](CONTROL, endpoint) as responder, _turning(turn):
            yield commands

    return answer


@pytest.fixture
def disk(request, tmp_path):
    """A disk of 64 MB, a tmpfs; another size in bytes is given as the parameter of this fixture."""
    folder, size = tmp_path / "disk", getattr(request, "param", 64 << 20)
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"only root may mount a small disk, for example in `unshare -rm pytest`: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture
def remount(disk):
    """Makes the disk read-only ("ro") or writable ("rw")."""
    return lambda option: subprocess.run(["mount", "-o", f"remount,bind,{option}", disk], check=True)


@pytest.fixture
def fill(disk):
    """Fills the disk, and returns the file that fills it."""

    def now():
        with (disk / "ballast").open("ab", buffering=0) as ballast, suppress(OSError):
            while True:
                ballast.write(bytes(4096))
        return disk / "ballast"

    return now


@pytest.fixture
def full():
    """Makes each write to a file that this process has open fail as on a full disk."""

    def now(path):
        handles = [int(handle.name) for handle in Path("/proc/self/fd").iterdir() if handle.resolve() == path.resolve()]
        assert handles, f"{path} is not open"
        with Path("/dev/full").open("wb") as nothing:
            for handle in handles:
                os.dup2(nothing.fileno(), handle)

    return now


class Camera:
    """A camera on the network: MJPEG over HTTP, 40 images a second.

    sent   how many images were sent
    sends  cleared to freeze it
    """

    def __init__(self, image: Callable[[int], np.ndarray], port: int = 0) -> None:
        self.sent, self.sends, self._gone = 0, threading.Event(), False
        self.sends.set()
        camera = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                with suppress(OSError):
                    camera._stream(self.wfile)

            def log_message(self, *_: object) -> None:
                pass

        self._image = image
        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_port
        self.url = f"http://127.0.0.1:{self.port}/cam/one.mjpg"
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def _stream(self, file) -> None:
        while not self._gone:
            if self.sends.wait(0.02):
                jpeg = cv2.imencode(".jpg", self._image(self.sent))[1].tobytes()
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.sent += 1  # before a reader can have it
                file.write(head.encode() + jpeg + b"\r\n")
                time.sleep(0.025)

    def leave(self) -> None:
        """Close all connections, and accept no more."""
        self._gone = True
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def camera():
    """Starts cameras that show `image(0)`, `image(1)` ...; optionally on the port of an earlier one."""
    cameras: list[Camera] = []

    def start(image: Callable[[int], np.ndarray], port: int = 0) -> Camera:
        cameras.append(Camera(image, port))
        return cameras[-1]

    yield start
    for each in cameras:
        each.leave()


@pytest.fixture
def walker():
    """The address of a camera with a patch that moves to and fro, and a function that finds its box in a JPEG."""
    rng = np.random.default_rng(4)
    field = np.kron(rng.integers(60, 200, (24, 32, 3), np.uint8), np.ones((10, 10, 1), np.uint8))
    patch = np.kron(rng.integers(0, 256, (5, 5, 3), np.uint8), np.ones((8, 8, 1), np.uint8))

    def image(number: int) -> np.ndarray:
        frame, x = field.copy(), 20 + abs(2 * number % 480 - 240)
        frame[100:140, x : x + 40] = patch
        return frame

    def find(jpeg: bytes) -> Box:
        picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        _, _, _, corner = cv2.minMaxLoc(cv2.matchTemplate(picture, patch, cv2.TM_CCOEFF_NORMED))
        return Box(*map(float, corner), 40.0, 40.0)

    started = Camera(image)  # tests/web has another fixture `camera`
    yield started.url, find
    started.leave()
