"""The fleet on a real cluster of Ray that the tests of a process share: Ray uses one cluster in a process."""

from __future__ import annotations

import pytest

from catstream.fleet.fleet import Fleet
from catstream.fleet.local import LocalCluster
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.video.live_demo import first_box

FRAMES = 32
LIVE = "demo:1"


@pytest.fixture(scope="session")
def home(tmp_path_factory):
    """The folder of the fleets of these tests."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(home))
        patch.setenv("XDG_RUNTIME_DIR", "")
        patch.delenv("RAY_ADDRESS", raising=False)
        yield home / "catstream" / "fleets"


@pytest.fixture(scope="session")
def streams(demo_video):
    path, truth = demo_video(FRAMES)
    film = StreamSpec("film", str(path), {"": truth[0]}, settings={"run.lockstep": True}, cores=0.3)
    return {"film": film, "gate": StreamSpec("gate", LIVE, {"anna": first_box(LIVE)}, cores=0.3)}


@pytest.fixture(scope="session")
def site(home, streams, tmp_path_factory):
    """A fleet of two streams on two nodes, and its spec."""
    spec = FleetSpec("site", str(tmp_path_factory.mktemp("store") / "new"), every=0.5, nodes=2, streams=streams)
    with Fleet(spec) as site:
        site.up(cores=1)
        yield site, spec
    assert not LocalCluster(home / "site").running
    assert sorted(path.name for path in (home / "site").iterdir()) == ["log", "pid", "starting", "token"]
