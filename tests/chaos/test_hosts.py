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

from catstream.compression.compressor import Compressor
from catstream.errors import CatstreamError
from catstream.services.supervisor import NAMES
from catstream.settings import Settings
from catstream.wire.keys import allow, create

CUT_SECONDS = 2.0


@pytest.fixture
def hosts():
    """One for each process, and one of somebody who watches."""
    try:
        with Hosts(*NAMES, "viewer") as made:
            yield made
    except OSError as error:
        pytest.skip(f"no hosts can be made: {error}")


@pytest.fixture
def pipeline(video, hosts, tmp_path):
    """The processes by name, and one that watches; each on its host, with the keys that are its due."""
    path, boxes = video
    create(tmp_path / "keys")
    allow(tmp_path / "keys", "viewer", "watch", output=tmp_path / "viewer")
    first, *others = (f"{name}={hosts.addresses[name]}" for name in NAMES)
    endpoint = f"tcp://{','.join([first.partition('=')[2], *others])}:5700"
    common = ["--set", f"endpoint={endpoint}", "--set", "lockstep=true", "--set", f"keys={tmp_path / 'keys'}"]
    own = {
        "compressor": ["--state", tmp_path / "state"],
        "trainer": [],
        "detector": ["--resume", path, "--box", ",".join(map(str, boxes[0]))],
    }
    watch = ["watch", "tracks", "--json", "--endpoint", endpoint, "--keys", tmp_path / "viewer"]
    viewer = hosts.start("viewer", Path(sys.executable).with_name("catstream"), *watch, stdout=subprocess.PIPE)
    services = [sys.executable, "-m", "catstream.services"]
    return {name: hosts.start(name, *services, name, *common, *own[name]) for name in NAMES} | {"viewer": viewer}


@pytest.mark.parametrize(
    "victim", ["compressor", *(pytest.param(name, marks=pytest.mark.slow) for name in ("detector", "trainer"))]
)
def test_a_host_that_is_cut_off_for_a_while_costs_nothing(video, calm, hosts, pipeline, until, tmp_path, victim):
    until(lambda: reached(tmp_path / "state", 5))
    with hosts.cut_off(victim):
        time.sleep(CUT_SECONDS)
        assert reached(tmp_path / "state", 0).seq < len(video[1]), "the video was over before the host was cut off"
    heard = pipeline.pop("viewer").communicate()[0].splitlines()
    assert {name: process.wait(60) for name, process in pipeline.items()} == dict.fromkeys(NAMES, 0)
    tracks, learned = calm
    assert chaos.fingerprint(reached(tmp_path / "state", 0)) == chaos.fingerprint(learned)
    assert [json.loads(line)["frame"] for line in heard if "frame" in line][-1] == tracks[-1].frame


def reached(state, seq):
    """The last checkpoint, where there is one of a message after `seq`."""
    try:
        compressor = Compressor.load(state / "compressor.safetensors", Settings(lockstep=True))
    except (CatstreamError, OSError):
        return None
    return compressor if compressor.seq > seq else None
