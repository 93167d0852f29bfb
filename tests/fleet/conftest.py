"""The Ray cluster that all tests share: starting one takes ten seconds of processor."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

import pytest

from catstream.errors import MissingExtraError
from catstream.extras import require_extra
from catstream.fleet import cluster
from catstream.fleet.local import LocalFleet
from catstream.storage import is_locked, lock

#: The nodes of the shared fleet, without the head; each has one core.
NODES = 2


@pytest.fixture(scope="session")
def fleet(tmp_path_factory) -> Iterator[LocalFleet]:
    """A local fleet with a head and the nodes node-1 and node-2, to which this process is connected.

    All processes that share the tests use the same one. A test that kills a node starts one of its own for this,
    without cores (`fleet.start_node(NAME, 0)`), and stops it.
    """
    try:
        require_extra("fleet")
    except MissingExtraError as error:
        pytest.skip(str(error))
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "fleet"
    folder.mkdir(exist_ok=True)
    shared, runtime = LocalFleet(folder), runtime_of(folder)
    with _user(folder / f"{os.getpid()}.user") as mine:
        with _locked(folder / "lock"), pytest.MonkeyPatch.context() as patch:
            runtime.mkdir(mode=0o700, exist_ok=True)
            patch.setenv("XDG_RUNTIME_DIR", str(runtime))  # that of this process ends with its tests
            shared.start(NODES, cores=1)
        cluster.connect(shared.address, shared.token_file)
        yield shared
        cluster.disconnect()
        with _locked(folder / "lock"):
            if not any(_is_used(path) for path in folder.glob("*.user") if path != mine):
                shared.stop()
                shutil.rmtree(runtime)


@pytest.fixture(scope="session")
def runtime(fleet) -> Path:
    """The folder in which the processes of the fleet leave the notes by which others find them."""
    return runtime_of(fleet.folder)


def runtime_of(folder: Path) -> Path:
    return Path("/tmp") / f"cs-{sha256(bytes(folder)).hexdigest()[:8]}"


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        assert lock(file.fileno(), seconds=170), "another process of the tests starts the fleet for too long"
        yield


@contextmanager
def _user(path: Path) -> Iterator[Path]:
    """A file that stays locked as long as this process uses the fleet, or lives."""
    with path.open("w") as file:
        lock(file.fileno())
        yield path
        path.unlink()


def _is_used(path: Path) -> bool:
    try:
        with path.open() as file:
            return is_locked(file.fileno())
    except OSError:
        return False
