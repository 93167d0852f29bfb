"""What the tests of the command line share."""

from __future__ import annotations

import io
import logging
import signal
import subprocess
import sys
from contextlib import ExitStack, redirect_stderr, redirect_stdout

import pytest

from catstream.cli import main

#: The command `catstream` in a process of its own.
PROGRAM = [sys.executable, "-c", "from catstream.cli import main; main()"]


@pytest.fixture(scope="session")
def video(demo_video):
    """A short demo video of 32 frames, and the box in its first frame as `--box` takes it."""
    path, boxes = demo_video(32)
    return str(path), ",".join(map(str, boxes[0]))


@pytest.fixture(scope="session")
def long_video(demo_video):
    """The same of 60 frames, for events that take longer."""
    path, boxes = demo_video(60)
    return str(path), ",".join(map(str, boxes[0]))


@pytest.fixture(scope="session")
def whole_run(video, once):
    """The folder of a run in lockstep that nothing disturbed.

    out     its results, with a video
    model   what it has learned
    rec     its recording
    stdout  its tracks, as `--write -` prints them
    stderr  what it told
    """

    def run(folder):
        source, box = video
        files = ["--output", "out", "--video", "--save-model", "model", "--record", "rec", "--write", "-"]
        with (folder / "stdout").open("w") as output, (folder / "stderr").open("w") as errors:
            command = [*PROGRAM, "track", source, "--box", box, *files, "--lockstep"]
            subprocess.run(command, cwd=folder, stdout=output, stderr=errors, check=True)

    return once("whole-run", run)


@pytest.fixture
def catstream():
    """Starts the command `catstream`; what still runs after the test is killed."""
    # In the background a shell has Ctrl-C ignored, and children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with ExitStack() as stack:

        def start(*arguments, **options):
            process = subprocess.Popen(
                [*PROGRAM, *map(str, arguments)],
                **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options},
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start


@pytest.fixture
def said_by_process(catstream):
    """Runs the command as a process of its own, to its end: exit code, output, errors."""

    def run(*arguments, **options):
        process = catstream(*arguments, **options)
        output, errors = process.communicate(timeout=120)
        return process.returncode, output, errors

    return run


@pytest.fixture
def said():
    """Runs the command in this process, which imports nothing anew: exit code, output, errors."""

    def run(*arguments, cwd=None, env=None):
        output, errors = io.StringIO(), io.StringIO()
        warnings = logging.StreamHandler(errors)
        warnings.setLevel(logging.WARNING)
        with (
            pytest.MonkeyPatch.context() as patch,
            redirect_stdout(output),
            redirect_stderr(errors),
            ExitStack() as stack,
        ):
            logging.getLogger().addHandler(warnings)
            stack.callback(logging.getLogger().removeHandler, warnings)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                stack.callback(signal.signal, number, signal.getsignal(number))
            patch.setattr(sys, "argv", ["catstream", *map(str, arguments)])
            if cwd is not None:
                patch.chdir(cwd)
            for name, value in (env or {}).items():
                patch.setenv(name, value)
            code = 0
            try:
                main()
            except SystemExit as end:
                code = end.code or 0
        return code, output.getvalue(), errors.getvalue()

    return run


@pytest.fixture
def succeed(said):
    """Runs the command in this process, which must succeed: output, errors."""

    def run(*arguments, **options):
        code, output, errors = said(*arguments, **options)
        assert code == 0, errors
        return output, errors

    return run


@pytest.fixture
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
