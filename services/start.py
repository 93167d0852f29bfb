"""Starts processes of catstream without importing anything from the current folder.

For `python -m` and `python -c`, Python puts the current folder first on `sys.path`, so a file `zmq.py` there would be
imported in place of the library. A child process gets the `sys.path` of its parent without the current folder: it
imports the same catstream and the same libraries as its parent.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker, spawn
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any

from catstream import errors


def python_command(program: str, *arguments: str) -> list[str]:
    """The command that runs a program with the modules of this process; run it with the variables of `environment`.

    Raises
    ------
    ServiceError
        If no Python interpreter is known.
    """
    # Folders that only the interpreter knows come last; `-P` and no PYTHONPATH keep the current folder off its list.
    start = f"import sys; sys.path[:] = dict.fromkeys({import_path()!r} + sys.path); {program}"
    return [_interpreter(), "-P", "-c", start, *arguments]


def environment() -> dict[str, str]:
    """The environment variables of a child: no settings, and no current folder in `PYTHONPATH`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("CATSTREAM_")}
    return kept | {"PYTHONPATH": _python_path()}


class _Process(SpawnProcess):
    """A process of `multiprocessing` that imports nothing from the current folder."""

    @staticmethod
    def _Popen(process_obj: Any) -> Any:
        with _safe_path():
            return SpawnProcess._Popen(process_obj)


class _Context(SpawnContext):
    """The start method "spawn" for processes that import nothing from the current folder."""

    Process = _Process

    def get_context(self, method: str | None = None) -> Any:
        """Called for each lock and queue, which would otherwise start the resource tracker with the unsafe path."""
        with _safe_path():
            resource_tracker.ensure_running()
        return super().get_context(method)


#: The start method for processes that run a function of this program: worker pools, subscribers of a load test.
SPAWN = _Context()


@contextmanager
def sigint_blocked() -> Iterator[None]:
    """Block SIGINT in the processes that are started inside a `with`: on Ctrl-C, their parent ends them in order.

    A Ctrl-C that arrives inside is handled after it. The mask alone does not hold it back: the signal arrives in
    another thread, and Python handles it in the main one. A process whose start is interrupted would wait for its
    arguments.
    """
    SPAWN.get_context()  # starts the resource tracker now, because its start unblocks the signal
    received: list[int] = []
    is_main = threading.current_thread() is threading.main_thread()  # the thread in which Python handles signals
    handler = signal.signal(signal.SIGINT, lambda number, _: received.append(number)) if is_main else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a child inherits it
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if is_main:
            signal.signal(signal.SIGINT, handler)
            if received:
                signal.raise_signal(signal.SIGINT)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Change variables of this process while `multiprocessing` starts a child: it offers no other way."""
    names = ("PYTHONSAFEPATH", "PYTHONPATH")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(zip(names, ("1", _python_path()), strict=True))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _python_path() -> str:
    """`PYTHONPATH` without the current folder."""
    return os.pathsep.join(_without_the_current_folder(os.environ.get("PYTHONPATH", "").split(os.pathsep)))


def import_path() -> list[str]:
    """`sys.path` without the current folder."""
    return _without_the_current_folder(sys.path)


def _without_the_current_folder(entries: list[str]) -> list[str]:
    """The absolute folders among these, except the current one unless catstream itself was imported from it."""
    home = Path(errors.__file__).parents[1]
    try:
        here = Path.cwd()
    except FileNotFoundError:  # it was removed
        here = home
    kept = []
    for entry in entries:
        folder = here / entry
        if folder == home or (Path(entry).is_absolute() and folder.resolve() != here.resolve()):
            kept.append(str(folder))
    return kept


def _interpreter() -> str:
    """Path of the Python interpreter; `sys.executable` may be a program that embeds Python, or empty."""
    given = os.fsdecode(spawn.get_executable() or "")
    if given and (given != sys.executable or "py" in Path(given).name):
        return given
    beside = Path(sys.prefix, "bin", f"python{sys.version_info.major}.{sys.version_info.minor}")
    if not beside.exists():
        raise errors.ServiceError(
            f"no Python interpreter to start processes with, sys.executable is {sys.executable!r}: "
            "name one with multiprocessing.set_executable(PATH)"
        )
    return str(beside)
