"""A fleet on Ray: streams that are started, moved, continued after a death, refused and removed."""

import json
import os
import secrets
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
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

FRAMES = 32
LIVE = "demo:1"
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


def command(*words):
    return [sys.executable, "-P", "-c", "from catstream.cli import main; main()", *map(str, words)]


def run(*words):
    """A command from its start to its end."""
    return subprocess.run(command(*words), capture_output=True, text=True, timeout=500, check=False)


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


@contextmanager
def local(file, until, *options):
    """`catstream fleet up` in the foreground, once the stream runs."""
    words, name = command("fleet", "up", file, *options), options[-1] if options else "local"
    both = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(words, **both, text=True, start_new_session=True) as up:
        try:
            until(lambda: up.poll() is not None or name in fleets())
            assert up.poll() is None, up.communicate()[1]
            with Registry(name, timeout=500) as registry:
                until(lambda: [each.state for each in registry.streams().streams.values()] == ["running"])
            yield up
        finally:
            if up.poll() is None:
                up.kill()


@pytest.mark.usefixtures("home")
def test_a_local_fleet_is_closed_to_other_machines_and_users_until_ctrl_c(file, home, alive, until):
    with local(file, until) as up:
        processes = psutil.Process(up.pid).children(recursive=True)
        found = set().union(*map(listening, processes))
        assert found
        assert found <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
        folder = home / "local"
        assert (folder / "token").stat().st_mode & 0o077 == 0
        (file.parent / "token").write_text("0" * 64)
        other = {"RAY_AUTH_TOKEN_PATH": str(file.parent / "token"), "RAY_NUM_REDIS_GET_RETRIES": "2"}
        stranger = os.environ | _VARIABLES | other
        program = f"import ray; ray.init({(folder / 'address').read_text()!r}); print('let in')"
        words = [sys.executable, "-P", "-c", program]
        done = subprocess.run(words, env=stranger, capture_output=True, text=True, timeout=500, check=False)
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


@pytest.mark.usefixtures("home")
def test_sigterm_ends_a_local_fleet_as_ctrl_c_does(file, home, alive, until):
    with local(file, until) as up:
        processes = psutil.Process(up.pid).children(recursive=True)
        up.terminate()  # as systemd does; Ray has a handler of its own
        check_ended(up, processes, home, alive, until)


@pytest.mark.usefixtures("home")
@pytest.mark.parametrize("victim", ["raylet", "gcs_server"])
def test_a_local_fleet_ends_with_its_streams_and_keeps_its_logs_if_ray_dies(file, home, alive, until, victim):
    with local(file, until) as up:
        processes = psutil.Process(up.pid).children(recursive=True)
        next(each for each in processes if each.name() == victim).kill()
        said = up.communicate(timeout=500)[1]
        assert up.returncode == 1
        assert f"the fleet local has ended, because Ray's {victim} has died (exit status -9): start it again" in said
        until(lambda: not any(alive(each.pid) for each in processes))  # no orphan writes beside the next start
        assert (home / "local" / "logs" / f"{victim}.out").exists()


@pytest.mark.usefixtures("home")
def test_a_second_up_changes_a_fleet_that_runs_and_down_ends_it_from_elsewhere(file, until):
    with ThreadPoolExecutor(1) as pool, local(file, until, "--name", "other") as up:
        second = pool.submit(run, "fleet", "up", file, "--name", "other").result()
        assert (second.returncode, second.stdout.splitlines()[0]) == (0, "gate: is unchanged")
        assert list(json.loads(run("fleet", "status", "--fleet", "other", "--json").stdout)["streams"]) == ["gate"]
        assert run("fleet", "down", "--name", "other").stdout == "the fleet other is down\n"
        assert "the fleet other was ended from elsewhere" in up.communicate(timeout=500)[0]
    assert up.returncode == 0
    assert "no fleet 'other' of yours runs" in run("fleet", "down", "--name", "other").stderr


# On a cluster.


@pytest.fixture(scope="module")
def streams(demo_video):
    path, truth = demo_video(FRAMES)
    film = StreamSpec("film", str(path), {"": truth[0]}, settings={"run.lockstep": True}, cores=0.3)
    return {"film": film, "gate": StreamSpec("gate", LIVE, {"anna": first_box(LIVE)}, cores=0.3)}


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


def state_of(fleet, name, until, *states):
    """The status of a stream once it has one of these states."""
    return until(lambda: (found := fleet.status().streams[name]).state in states and found)


def test_a_subscriber_with_a_key_of_the_fleet_stays_attached_to_a_stream_that_moves(
    site, streams, until, home, tmp_path
):
    fleet, spec = site
    before = state_of(fleet, "gate", until, "running")
    allow(home / "site" / "keys", "desk", "watch", output=tmp_path / "desk")
    other = "south" if before.node == "north" else "north"
    address, keys = f"fleet://{spec.registry}/gate", str(tmp_path / "desk")
    with ExitStack() as stack:

        def attached():
            with suppress(ServiceError):  # the stream does not know the client yet
                subscription = stack.enter_context(catstream.subscribe(address, "tracks", timeout=500, keys=keys))
                return subscription, next(subscription)

        tracks, first = until(attached)
        fleet.add(replace(streams["gate"], labels={"ray.io/node-id": node_id(other)}))
        until(lambda: (found := fleet.status().streams["gate"]).node == other and found.state == "running")
        endpoint = tracks.endpoint
        next(track for track in tracks if tracks.endpoint != endpoint)
    assert first.object == "anna"
    assert fleet.status().streams["gate"].token > before.token
    fleet.add(replace(streams["gate"], labels={"site": "west"}))
    until(lambda: "Ray has not started it" in fleet.status().streams["gate"].trouble)
    fleet.add(streams["gate"])
    state_of(fleet, "gate", until, "running")


def node_id(name):
    """The id of a node, which Ray has as a label."""
    return next(node["NodeID"] for node in nodes() if node["NodeName"] == name)


def test_a_stream_runs_on_a_node_with_its_labels_and_moves_when_the_node_dies(site, cluster, streams, until):
    fleet, spec = site
    fleet.add(replace(streams["gate"], labels={"site": "south"}))
    until(lambda: (found := fleet.status().streams["gate"]).node == "south" and found.state == "running")
    fleet.add(StreamSpec("full", LIVE, cores=0.8, labels={"ray.io/node-id": node_id("north")}))
    state_of(fleet, "full", until, "waiting")
    fleet.add(streams["gate"])  # it may run anywhere, and only this node has room
    until(lambda: (found := fleet.status().streams["gate"]).node == "south" and found.state == "running")
    fleet.remove("full", forget=True)
    token = fleet.status().streams["gate"].token
    until(lambda: (state := Store(spec.store).stream("gate").newest()) is not None and state.token == token)
    before = fleet.status().streams["gate"]
    cluster.remove_node(cluster.south, allow_graceful=False)
    until(lambda: (found := fleet.status().streams["gate"]).token > before.token and found.state == "running")
    assert fleet.status().streams["gate"].node == "north"
    until(lambda: fleet.status().nodes["south"].state == "dead")
    cluster.south = cluster.add_node(**SOUTH)
    until(lambda: fleet.status().nodes["south"].state == "alive")


def test_a_controller_that_dies_is_started_again_and_streams_run_on(site, until):
    fleet, _ = site
    before = state_of(fleet, "gate", until, "running")
    ray = import_module("ray")
    ray.kill(fleet._controller, no_restart=False)
    after = state_of(fleet, "gate", until, "running")
    assert after.token == before.token
    assert fleet.is_running
