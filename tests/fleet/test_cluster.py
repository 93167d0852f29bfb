from __future__ import annotations

import json
import os
import runpy
import socket
import subprocess
import sys
import threading
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from catstream.cli.fleet_nodes import head, node
from catstream.errors import FleetError, UnreachableError
from catstream.fleet import cluster, keeper, probe
from catstream.fleet.local import LocalFleet
from catstream.loadtest.nodes import kill_node

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
with pytest.MonkeyPatch.context() as patch:
    patch.setattr(sys, "path", [str(BENCHMARKS / "fleet"), str(BENCHMARKS), *sys.path])  # as Python has it for a script
    PORTS, STRANGERS = (runpy.run_path(str(BENCHMARKS / "fleet" / f"{name}.py")) for name in ("ports", "strangers"))


@pytest.fixture
def token(tmp_path):
    cluster.make_token(tmp_path / "token")
    return tmp_path / "token"


@given(st.ip_addresses(v=4))
def test_no_address_that_the_internet_routes_is_accepted(address):
    try:
        cluster.private_address(f"{address}:6400")
    except FleetError:
        return
    assert address.is_private
    assert not address.is_global


@pytest.mark.parametrize("host", ["127.0.0.1", "10.255.255.255", "172.16.0.1", "192.168.1.2"])
def test_private_addresses_are_accepted(host):
    assert cluster.private_address(f"{host}:6400") == (host, 6400)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("8.8.8.8:6400", "not a private address"),
        ("0.0.0.0:6400", "not a private address"),
        ("127.0.0.2:6400", "all interfaces"),
        ("camera.example:6400", "expected an IPv4 address"),
        ("10.0.0.1", "expected an IPv4 address"),
        ("10.0.0.1:80", "port above 1023"),
    ],
)
def test_an_address_that_strangers_could_reach_is_refused(text, line, token):
    with pytest.raises(FleetError, match=line):
        cluster.private_address(text)
    for command, options in ((head, ["--listen", text]), (node, ["--head", text, "--token-file", str(token)])):
        done = CliRunner().invoke(command, [*options, "--folder", str(token.parent)])
        assert isinstance(done.exception, FleetError)


def test_there_is_no_option_for_a_public_address():
    assert all("public" not in option for command in (head, node) for p in command.params for option in p.opts)


def test_a_token_is_made_once_for_this_user_alone(token):
    first = cluster.read_token(token)
    cluster.make_token(token)
    assert (cluster.read_token(token), len(first), token.stat().st_mode & 0o777) == (first, 64, 0o600)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda path: path.chmod(0o640), "other users can access"),
        (lambda path: path.write_text("short"), "32 characters"),
        (lambda path: path.write_bytes(b"\xff" * 64), "not a text"),
        (lambda path: path.unlink(), "copy the file `token`"),
    ],
)
def test_nothing_starts_or_connects_without_a_token(token, spoil, line, tmp_path):
    spoil(token)
    with pytest.raises(FleetError, match=line):
        cluster.connect("127.0.0.1:6400", token)
    with pytest.raises(FleetError, match=line):
        keeper.keep_node("127.0.0.1:6400", token, tmp_path, "n", 1.0, {})


def test_each_process_of_ray_asks_for_the_token_and_none_has_it_in_its_environment(token, tmp_path):
    variables = cluster.environment(token, tmp_path / "gcs")
    assert variables["RAY_AUTH_MODE"] == "token"
    assert variables["RAY_AUTH_TOKEN_PATH"] == str(token)
    assert cluster.read_token(token) not in str(variables)


def test_variables_of_the_user_for_another_cluster_do_not_reach_ray(token, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.9:6379")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "of another cluster")
    variables = cluster.child_environment(token)
    assert {name for name in variables if name.startswith("RAY_")} == cluster.environment(token).keys()


def entry(name, number, alive, since):
    labels = {"catstream/node": name, "catstream/since": str(since), "catstream/cores": "0.5", "site": "north"}
    return {
        **{"NodeID": f"{number:056x}", "Alive": alive, "NodeName": name, "NodeManagerAddress": "10.0.0.1"},
        **{"Labels": labels, "Resources": {"CPU": 1.0} if alive else {}},
    }


@given(st.lists(st.tuples(st.sampled_from("abc"), st.booleans(), st.integers(0, 9)), unique_by=lambda x: (x[0], x[2])))
def test_a_name_appears_once_as_its_newest_living_node(history):
    entries = [entry(name, number, alive, since) for number, (name, alive, since) in enumerate(history)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "ray", SimpleNamespace(nodes=lambda: entries))
        found = {facts.name: facts for facts in cluster.nodes()}
    for name in {name for name, _, _ in history}:
        *_, number = max((alive, since, i) for i, (other, alive, since) in enumerate(history) if other == name)
        assert found[name].id == f"{number:056x}"
        assert (found[name].cores, found[name].labels) == (0.5, {"site": "north"})
    assert len(found) == len({name for name, _, _ in history})


@pytest.mark.parametrize("name", ["catstream", "python", "ray"])
def test_a_node_with_another_version_is_named(name):
    other = {"name": "cam-host", "labels": {f"catstream/{name}": "9.9"}}
    with pytest.raises(FleetError, match=rf"node cam-host has {name} 9\.9, this machine has "):
        cluster._check_versions([other])


@pytest.mark.parametrize(("name", "labels"), [("a b", {}), ("n", {"site": "north,x=1"}), ("n", {"": "north"})])
def test_a_name_or_label_that_ray_would_not_take_is_refused(name, labels, token, tmp_path):
    with pytest.raises(FleetError, match="letters, digits"):
        keeper.keep_node("127.0.0.1:6400", token, tmp_path, name, 1.0, labels)


def test_fixed_ports_are_a_hundred_from_the_first():
    ports = [int(word) for word in keeper._ports(6401) if word.isdecimal()]
    assert (min(ports), max(ports), len(set(ports))) == (6401, 6500, len(ports))


def test_a_second_keeper_of_a_node_is_refused(tmp_path):
    with (
        keeper._alone("n", tmp_path),
        pytest.raises(FleetError, match=f"process {os.getpid()}"),
        keeper._alone("n", tmp_path),
    ):
        pass
    assert keeper.holder("n", tmp_path) is None


def test_ray_is_started_again_after_its_death_with_the_cause_in_one_line(monkeypatch, caplog):
    """A program in the place of Ray that reports the death of its raylet as Ray does."""
    report = ["Some Ray subprocesses exited unexpectedly:", "raylet [exit code=-9]", "----- BEGIN raylet.out", "noise"]
    program = (
        f"for line in {report}: print('2026-01-01 00:00:00,000\\tERR scripts.py:1 -- ' + line)\nraise SystemExit(1)"
    )
    monkeypatch.setattr(keeper, "_FIRST_PAUSE", 0.01)
    popen = subprocess.Popen
    monkeypatch.setattr(
        keeper.subprocess, "Popen", lambda _, **options: popen([sys.executable, "-c", program], **options)
    )
    ended = threading.Event()

    class Counter(keeper.logging.Handler):
        def emit(self, _):
            if len(caplog.records) >= 3:
                ended.set()

    keeper._log.addHandler(counter := Counter())
    try:
        keeper._Keeper("node n", [], {}, {}, "started").run(ended)
    finally:
        keeper._log.removeHandler(counter)
    lines = [record.getMessage() for record in caplog.records[:3]]
    assert lines == [
        f"node n died with exit code 1: raylet [exit code=-9]; next attempt in {pause:g} s"
        for pause in (0.01, 0.02, 0.04)
    ]


def test_a_cluster_that_asks_for_no_token_is_not_joined(token, monkeypatch):
    monkeypatch.delitem(sys.modules, "ray", raising=False)  # another test may have connected this process
    answered = subprocess.CompletedProcess([], 0, stdout=json.dumps({"open": True}).encode())
    monkeypatch.setattr(cluster.subprocess, "run", lambda *_, **__: answered)
    monkeypatch.setattr(cluster.socket, "create_connection", lambda *_: SimpleNamespace(close=lambda: None))
    with pytest.raises(FleetError, match="asks for no token"):
        cluster.connect("10.0.0.1:6400", token)
    with pytest.raises(FleetError, match="asks for no token"):
        keeper._check_head("n", "10.0.0.1:6400", token)


def test_a_head_that_answers_without_a_token_is_recognised(monkeypatch):
    class RefusedError(Exception):
        pass

    modules = {
        "ray._raylet": SimpleNamespace(GcsClient=lambda address: address, AuthenticationTokenLoader=None),
        "ray.exceptions": SimpleNamespace(AuthenticationError=RefusedError),
    }
    monkeypatch.setattr(probe, "import_module", modules.__getitem__)
    monkeypatch.setenv("RAY_AUTH_TOKEN", "of the user")
    assert probe.ask("10.0.0.1:6400") == {"open": True}


def test_a_head_that_does_not_run_is_said_to_be_unreachable(token):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(UnreachableError, match=f"nothing answers at {address}"):
        cluster.probe(address, token)


@pytest.mark.system
@pytest.mark.usefixtures("fleet")
def test_the_nodes_of_a_fleet_have_their_names_cores_and_versions():
    found = {facts.name: facts for facts in cluster.nodes() if facts.alive}
    assert {"head", "node-1", "node-2"} <= found.keys()
    assert [(found[name].cores, found[name].head) for name in ("head", "node-1")] == [(0.0, True), (1.0, False)]
    assert all(facts.versions == cluster.versions() for facts in found.values())


@pytest.mark.system
def test_a_fleet_is_found_again_by_its_folder(fleet):
    other = LocalFleet(fleet.folder)
    assert other.running
    assert (other.address, {"node-1", "node-2"} <= set(other.names)) == (fleet.address, True)
    other.start(2)  # nothing is missing
    cluster.connect(other.address, other.token_file)  # to the same one again


@pytest.mark.system
@pytest.mark.usefixtures("fleet")
def test_a_process_uses_one_fleet_at_a_time(token):
    with pytest.raises(FleetError, match="one fleet at a time"):
        cluster.connect("10.0.0.1:6400", token)


def test_ray_that_was_imported_without_a_token_is_refused_at_once(token, monkeypatch):
    monkeypatch.setattr(cluster, "_connected", lambda _: False)
    monkeypatch.setitem(sys.modules, "ray", module_from_spec(find_spec("ray")))
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    with pytest.raises(FleetError, match="Ray was imported before the fleet"):
        cluster.connect("10.0.0.1:6400", token)


def test_a_command_connects_before_it_imports_ray(token):
    program = f"""
import sys
from catstream.errors import FleetError
from catstream.fleet import fleet

def connect(*_):
    raise FleetError("ray" if "ray" in sys.modules else "nothing was imported")

fleet.connect = connect
fleet.Fleet(name="site", address="10.0.0.1:6400", token_file={str(token)!r}).move("cam-7", "north-1")
"""
    done = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=False)
    assert "FleetError: nothing was imported" in done.stderr


@pytest.mark.system
def test_a_wrong_token_is_refused_by_the_head(fleet, token):
    with pytest.raises(FleetError, match="refuses the token"):
        keeper._check_head("stranger", fleet.address, token)


@pytest.mark.system
def test_every_port_of_a_local_fleet_is_on_the_loopback_interface(fleet):
    listening = [port for name in ("head", "node-1", "node-2") for port in PORTS["listening"](fleet, name)]
    assert len(listening) >= 1 + 3 * 3  # the GCS; node manager, object manager and runtime environments of each node
    assert {port.address for port in listening} == {"127.0.0.1"}


@pytest.mark.system
def test_a_node_that_was_killed_is_dead_at_once(fleet, until):
    fleet.start_node("fragile", 0, {"site": "north"})
    try:
        first = next(facts for facts in cluster.nodes() if facts.name == "fragile")
        assert (first.labels, first.alive) == ({"site": "north"}, True)
        kill_node(fleet, "fragile")
        until(lambda: not next(facts for facts in cluster.nodes() if facts.name == "fragile").alive)
        assert "fragile" not in fleet.names
    finally:
        fleet.stop_node("fragile")


@pytest.mark.system
@pytest.mark.parametrize("token", [None, "0" * 64], ids=["without a token", "with a wrong token"])
def test_a_stranger_on_this_machine_is_refused_at_every_port(fleet, token):
    calls = [
        *("NodeInfoGcsService/GetAllNodeInfo", "InternalKVGcsService/InternalKVKeys", "JobInfoGcsService/AddJob"),
        *("ActorInfoGcsService/RegisterActor", "NodeManagerService/RequestWorkerLease", "CoreWorkerService/PushTask"),
        *("NodeManagerService/ShutdownRaylet", "ObjectManagerService/Pull"),
    ]
    refused = set()
    for port in (port for name in ("head", "node-1") for port in PORTS["listening"](fleet, name)):
        for call in calls:
            status, size = STRANGERS["grpc"](port.address, port.number, f"/ray.rpc.{call}", token)
            assert size == 0, (port, call)
            assert status in ("16", "12", ""), (port, call)  # refused, no such service, no gRPC at all
            refused |= {call} if status == "16" else set()
        if "RuntimeEnv" in port.process:
            status, size = STRANGERS["web"](port.address, port.number, "/get_or_create_runtime_env", token)
            assert (status in ("401", "403"), size) == (True, 0)
    assert refused >= {*calls[:5], *calls[6:]}  # a worker's port is there only if an actor runs


@pytest.mark.system
@pytest.mark.usefixtures("fleet")
def test_ray_opens_no_port_for_its_client_or_its_dashboard_whatever_is_installed():
    check = (
        "from catstream.fleet import launch; launch._close_ports(); from ray._private import utils; "
        "from ray.scripts import scripts; "
        "print(scripts.get_ray_client_dependency_error(), utils.get_dashboard_dependency_error(), sep='|')"
    )
    done = subprocess.run([sys.executable, "-P", "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout == "a fleet does not use it|a fleet does not use it\n"
