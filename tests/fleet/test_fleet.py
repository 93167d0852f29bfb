"""A fleet on Ray: streams that are started, moved, continued after a death, refused and removed."""

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib import import_module

import psutil
import pytest

import catstream
from catstream.client.registry import Registry
from catstream.errors import ServiceError
from catstream.fleet import fleet as module
from catstream.fleet.controller import nodes
from catstream.fleet.fleet import _VARIABLES, Fleet
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import Store
from catstream.video.live_demo import first_box
from catstream.wire.discovery import fleets
from catstream.wire.keys import allow

pytestmark = pytest.mark.system

LIVE = "demo:1"
GATE = StreamSpec("gate", LIVE, {"anna": first_box(LIVE)}, cores=0.3)
NODE = {"num_cpus": 1, "object_store_memory": 80 << 20}
SOUTH = NODE | {"node_name": "south", "labels": {"site": "south"}}


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The folder of the fleets of these tests."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(home))
        patch.setenv("XDG_RUNTIME_DIR", "")
        patch.delenv("RAY_ADDRESS", raising=False)
        yield home / "catstream" / "fleets"


def listening(process):
    """The addresses at which a process listens; none if it has ended."""
    with suppress(psutil.Error):
        found = process.net_connections(kind="tcp")
        return {connection.laddr.ip for connection in found if connection.status == psutil.CONN_LISTEN}
    return set()


# On this machine alone, in processes of their own: a process uses one cluster.


@pytest.fixture
def file(tmp_path):
    (tmp_path / "local.toml").write_text(f'[streams.gate]\nsource = "{LIVE}"\nbox = [184, 88, 57, 58]\ncores = 0.2\n')
    return tmp_path / "local.toml"


@pytest.fixture
def local(home, file, catstream, until):  # noqa: ARG001  # its folder is in the environment
    """Starts `catstream fleet up` in the foreground: its process and its children, once the stream runs."""

    def start(name="local"):
        up = catstream("fleet", "up", file, "--name", name, start_new_session=True)
        until(lambda: up.poll() is not None or name in fleets())
        if up.poll() is not None:
            errors = up.communicate()[1]
            assert "timed out during startup" in errors, errors  # after 30 s, which is Ray's limit on a busy machine
            return start(name)
        with Registry(name, timeout=500) as registry:
            until(lambda: [each.state for each in registry.streams().streams.values()] == ["running"])
        return up, psutil.Process(up.pid).children(recursive=True)

    return start


def test_local_fleet_is_closed_to_other_machines_and_users(local, tmp_path, home, alive, until):
    up, processes = local()
    addresses = set().union(*map(listening, processes))
    assert addresses
    assert addresses <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    folder = home / "local"
    assert (folder / "token").stat().st_mode & 0o077 == 0
    (tmp_path / "token").write_text("0" * 64)
    other = {"RAY_AUTH_TOKEN_PATH": str(tmp_path / "token"), "RAY_NUM_REDIS_GET_RETRIES": "2"}
    program = f"import ray; ray.init({(folder / 'address').read_text()!r}); print('let in')"
    words, environment = [sys.executable, "-P", "-c", program], os.environ | _VARIABLES | other
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=500, check=False)
    assert (done.returncode, "let in" in done.stdout) == (1, False)
    assert "token" in done.stderr.lower()
    started = [each for each in processes if "StreamActor" in each.name()]
    assert [each.nice() for each in started] == [os.getpriority(os.PRIO_PROCESS, 0)]
    os.killpg(up.pid, signal.SIGINT)  # as a terminal does
    check_ended(up, processes, home, alive, until)


def check_ended(up, processes, home, alive, until):
    """Check that a local fleet ends in order: its streams have stored their states, and no process is left."""
    assert up.communicate(timeout=500)[0].splitlines()[-1] == "the fleet local is down"
    assert up.returncode == 0
    until(lambda: not any(alive(each.pid) for each in processes))
    assert not module._is_up(home / "local")
    assert Store(str(home / "local" / "store")).stream("gate").newest().facts["frame"] > 0


def test_sigterm_ends_a_local_fleet_as_ctrl_c_does(local, home, alive, until):
    up, processes = local()
    up.terminate()  # as systemd does; Ray has a handler of its own
    check_ended(up, processes, home, alive, until)


@pytest.mark.parametrize("victim", ["raylet", "gcs_server"])
def test_local_fleet_ends_with_its_streams_if_ray_dies(local, home, alive, until, victim):
    up, processes = local()
    next(each for each in processes if each.name() == victim).kill()
    errors = up.communicate(timeout=500)[1]
    assert up.returncode == 1
    assert f"the fleet local has ended, because Ray's {victim} has died (exit status -9): start it again" in errors
    until(lambda: not any(alive(each.pid) for each in processes))  # no orphan writes during the next run
    assert (home / "local" / "logs" / f"{victim}.out").exists()


def test_second_up_changes_a_fleet_and_down_ends_it_from_elsewhere(local, catstream, file):
    def run(*words):
        return catstream("fleet", *words).communicate(timeout=500)

    up, _ = local("other")
    assert run("up", file, "--name", "other")[0].splitlines()[0] == "gate: is unchanged"
    assert list(json.loads(run("status", "--fleet", "other", "--json")[0])["streams"]) == ["gate"]
    assert run("down", "--name", "other")[0] == "the fleet other is down\n"
    assert "the fleet other was ended from elsewhere" in up.communicate(timeout=500)[0]
    assert up.returncode == 0
    assert "no fleet 'other' of yours runs" in run("down", "--name", "other")[1]


# On a cluster.


@pytest.fixture(scope="module")
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


@pytest.fixture(scope="module")
def site(cluster, tmp_path_factory):
    """A fleet of a stream on two nodes, and its spec."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        registry = f"127.0.0.1:{probe.getsockname()[1]}"
    store = str(tmp_path_factory.mktemp("store") / "new")
    spec = FleetSpec("site", store, every=0.5, registry=registry, streams={"gate": GATE})
    with Fleet(spec, address=cluster.address) as site:
        site.up()
        yield site, spec
        assert site.down() == []


@pytest.fixture
def status_of(site, until):
    """A function that returns the status of a stream once it has this state, and runs on this node if one is named."""

    def wait(name, state="running", node=""):
        def current():
            status = site[0].status().streams[name]
            return status.state == state and node in ("", status.node) and status

        return until(current)

    return wait


def test_subscriber_with_a_key_stays_attached_to_a_stream_that_moves(site, status_of, until, home, tmp_path):
    fleet, spec = site
    before = status_of("gate")
    allow(home / "site" / "keys", "desk", "watch", output=tmp_path / "desk")
    other = "south" if before.node == "north" else "north"
    address, keys = f"fleet://{spec.registry}/gate", str(tmp_path / "desk")
    with ExitStack() as stack:

        def attached():
            with suppress(ServiceError):  # the stream does not know the client yet
                subscription = stack.enter_context(catstream.subscribe(address, "tracks", timeout=500, keys=keys))
                return subscription, next(subscription)

        tracks, first = until(attached)
        fleet.add(replace(GATE, labels={"ray.io/node-id": node_id(other)}))
        status_of("gate", node=other)
        endpoint = tracks.endpoint
        next(track for track in tracks if tracks.endpoint != endpoint)
    assert first.object == "anna"
    assert fleet.status().streams["gate"].token > before.token
    fleet.add(replace(GATE, labels={"site": "west"}))
    until(lambda: "Ray has not started it" in fleet.status().streams["gate"].trouble)
    fleet.add(GATE)
    status_of("gate")


def node_id(name):
    """The id of a node, which Ray has as a label."""
    return next(node["NodeID"] for node in nodes() if node["NodeName"] == name)


def test_stream_runs_on_a_node_with_its_labels_and_moves_if_it_dies(site, cluster, status_of, until):
    fleet, spec = site
    fleet.add(replace(GATE, labels={"site": "south"}))
    status_of("gate", node="south")
    fleet.add(StreamSpec("full", LIVE, cores=0.8, labels={"ray.io/node-id": node_id("north")}))
    status_of("full", "waiting")
    fleet.add(GATE)  # it may run anywhere, and only this node has room
    status_of("gate", node="south")
    fleet.remove("full", forget=True)
    stored = Store(spec.store).stream("gate")
    until(lambda: (state := stored.newest()) is not None and state.token == status_of("gate").token)
    before = status_of("gate")
    cluster.remove_node(cluster.south, allow_graceful=False)
    assert status_of("gate", node="north").token > before.token
    until(lambda: fleet.status().nodes["south"].state == "dead")
    cluster.south = cluster.add_node(**SOUTH)
    until(lambda: fleet.status().nodes["south"].state == "alive")


def test_controller_that_dies_is_restarted_while_streams_continue(site, status_of):
    fleet, _ = site
    before = status_of("gate")
    import_module("ray").kill(fleet._controller, no_restart=False)
    assert status_of("gate").token == before.token
    assert fleet.is_running
