"""Three hosts, one process each, as docker-compose.yml lays the pipeline out: over tcp, and with keys."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import chaos
import pytest
from hosts import Hosts

from catstream.errors import CatstreamError
from catstream.services.start_server import NAMES
from catstream.settings import Settings
from catstream.wire.keys import allow, create

pytestmark = pytest.mark.system

CUT_SECONDS = 2.0


@pytest.fixture(scope="session")
def video(demo_video):
    """As in the other tests, but longer: it must not be over before a host is disturbed."""
    path, boxes = demo_video(400)
    return str(path), boxes


@pytest.fixture(scope="session")
def calm(video):
    path, boxes = video
    return chaos.undisturbed(path, {chaos.FIRST: boxes[0]})


@pytest.fixture
def hosts():
    """One for each process, and one of somebody who watches."""
    try:
        with Hosts(*NAMES, "viewer") as made:
            yield made
    except OSError as error:
        pytest.skip(f"no hosts can be made: {error}")


@pytest.fixture
def start(video, hosts, tmp_path):
    """Starts a process on its host, or one that watches, with the keys that are its due."""
    path, boxes = video
    create(tmp_path / "keys")
    allow(tmp_path / "keys", "viewer", "watch", output=tmp_path / "viewer")
    first, *others = (f"{name}={hosts.addresses[name]}" for name in NAMES)
    endpoint = f"tcp://{','.join([first.partition('=')[2], *others])}:5700"
    common = [
        "--set",
        f"run.endpoint={endpoint}",
        "--set",
        "run.lockstep=true",
        "--set",
        "run.checkpoint_seconds=0.1",
        "--set",
        f"run.keys={tmp_path / 'keys'}",
    ]
    own = {
        "compressor": ["--state", tmp_path / "state"],
        "trainer": [],
        "detector": ["--resume", path, "--box", f"{chaos.FIRST}={','.join(map(str, boxes[0]))}"],
    }

    def begin(name):
        if name == "viewer":
            watch = ["watch", "tracks", "--json", "--endpoint", endpoint, "--keys", tmp_path / "viewer"]
            return hosts.start(name, Path(sys.executable).with_name("catstream"), *watch, stdout=subprocess.PIPE)
        return hosts.start(name, sys.executable, "-P", "-m", "catstream.services", name, *common, *own[name])

    return begin


@pytest.mark.parametrize(
    "victim", ["compressor", *(pytest.param(name, marks=pytest.mark.slow) for name in ("detector", "trainer"))]
)
def test_a_host_that_is_cut_off_for_a_while_costs_nothing(video, calm, hosts, start, until, tmp_path, victim):
    viewer, *processes = (start(name) for name in ("viewer", *NAMES))
    until(lambda: reached(tmp_path / "state", 5))
    with hosts.cut_off(victim):
        time.sleep(CUT_SECONDS)
        assert reached(tmp_path / "state", 0).seq < len(video[1]), "the video was over before the host was cut off"
    heard = viewer.communicate()[0].splitlines()
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    tracks, trees = calm
    assert chaos.fingerprint(reached(tmp_path / "state", 0)) == chaos.fingerprint(trees)
    assert [json.loads(line)["frame"] for line in heard if "frame" in line][-1] == len(tracks) - 1


@pytest.mark.slow
@pytest.mark.parametrize("victim", NAMES)
def test_a_host_that_loses_power_and_restarts_costs_no_frame(video, calm, hosts, start, until, tmp_path, victim):
    processes = {name: start(name) for name in NAMES}
    until(lambda: reached(tmp_path / "state", 5))
    hosts.power_off(victim, processes[victim])
    assert reached(tmp_path / "state", 0).seq < len(video[1]), "the video was over before the host went down"
    processes[victim] = start(victim)
    assert {name: process.wait(120) for name, process in processes.items()} == dict.fromkeys(NAMES, 0)
    assert chaos.fingerprint(reached(tmp_path / "state", 0)) == chaos.fingerprint(calm[1])


def reached(state, seq):
    """The last checkpoint; None if there is none of a message after `seq`."""
    try:
        forest = chaos.learned(state, Settings(run={"lockstep": True}))
    except (CatstreamError, OSError, ValueError):
        return None
    return forest if forest.seq > seq else None
