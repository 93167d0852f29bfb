"""A fleet on a real cluster of two nodes that the tests of a process share: Ray uses one cluster in a process."""

import secrets
import socket

import pytest

from catstream.fleet.fleet import _VARIABLES, Fleet
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.video.live_demo import first_box

FRAMES = 32
LIVE = "demo:1"
NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}
SOUTH = NODE | {"node_name": "south", "labels": {"site": "south"}}


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
def cluster(home):
    """A cluster of the nodes north and south, as `ray start` would start them, but on the loopback interface."""
    home.mkdir(parents=True, exist_ok=True)
    (home / "cluster-token").touch(mode=0o600)
    (home / "cluster-token").write_text(secrets.token_hex(32))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in _VARIABLES.items():
            patch.setenv(name, value)
        patch.setenv("RAY_AUTH_TOKEN_PATH", str(home / "cluster-token"))
        from ray.cluster_utils import Cluster

        cluster = Cluster(True, head_node_args=NODE | {"node_name": "north", "include_dashboard": False})
        cluster.south = cluster.add_node(**SOUTH)
        yield cluster
        cluster.shutdown()


@pytest.fixture(scope="session")
def site(cluster, streams, tmp_path_factory):
    """A fleet of two streams on two nodes, and its spec."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        registry = f"127.0.0.1:{probe.getsockname()[1]}"
    store = str(tmp_path_factory.mktemp("store") / "new")
    spec = FleetSpec("site", store, every=0.5, registry=registry, streams=streams)
    with Fleet(spec, address=cluster.address) as site:
        site.up()
        yield site, spec
        assert site.down() == []
