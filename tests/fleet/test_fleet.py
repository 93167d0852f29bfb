"""A fleet on a real cluster of Ray: streams that are started, moved, continued after a death, refused and removed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from importlib import import_module

import psutil
import pytest

import catstream
from catstream.client.registry import Registry
from catstream.errors import FleetError, StoreError
from catstream.fleet.fleet import Fleet
from catstream.fleet.local import LocalCluster
from catstream.fleet.merge import merge_streams
from catstream.fleet.spec import FleetSpec, StreamSpec
from catstream.fleet.store import Store
from catstream.services.start import environment, python_command
from catstream.wire.endpoint import fleets
from tests.fleet.conftest import LIVE

pytestmark = pytest.mark.system


def command(*words):
    return python_command("from catstream.cli import main; main()", *map(str, words))


def run(*words):
    """A command from its start to its end."""
    return subprocess.run(command(*words), env=environment(), capture_output=True, text=True, timeout=300, check=False)


def raylets(folder):
    """The processes of Ray on each node of a cluster on this machine, by the name of the node."""
    keeper = psutil.Process(int((folder / "pid").read_text()))
    words = {process: process.cmdline() for process in keeper.children() if process.name() == "raylet"}
    names = {process: next(word for word in words[process] if word.startswith("--node-name=")) for process in words}
    return {name.partition("=")[2]: process for process, name in names.items()}


def listening(process):
    """The addresses at which a process listens; none if it has ended."""
    with suppress(psutil.Error):
        found = process.net_connections(kind="tcp")
        return {connection.laddr.ip for connection in found if connection.status == psutil.CONN_LISTEN}
    return set()


@pytest.mark.usefixtures("site")
def test_all_ports_of_a_fleet_on_this_machine_are_on_the_loopback_interface(home):
    token = (home / "site" / "token").stat()
    assert token.st_mode & 0o077 == 0
    ray = import_module("ray")
    assert ray.get_runtime_context().gcs_address.startswith("127.0.0.1:")
    (keeper,) = {process.parent() for process in raylets(home / "site").values()}
    found = set().union(*map(listening, keeper.children(recursive=True)))
    assert found
    assert found <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}


@pytest.mark.usefixtures("site")
def test_a_stranger_without_the_token_is_refused(home, tmp_path):
    """A process of its own, because Ray reads the token once."""
    local = LocalCluster(home / "site")
    (tmp_path / "token").write_text("0" * 64)
    variables = local.variables | {"RAY_AUTH_TOKEN_PATH": str(tmp_path / "token")}
    program = f"import ray; ray.init({local.address!r}); print('let in')"
    done = subprocess.run(
        python_command(program), env=environment() | variables, capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, "let in" in done.stdout) == (1, False)
    assert "token" in done.stderr.lower()


def test_a_subscriber_stays_attached_to_a_stream_that_moves(site, until):
    fleet, _ = site
    until(lambda: fleet.status().streams["gate"].state == "running")
    before = fleet.status().streams["gate"]
    other = "node-2" if before.node == "node-1" else "node-1"
    with catstream.subscribe("fleet://site/gate", "tracks", timeout=60) as tracks:
        first = next(tracks)
        assert fleet.move("gate", other) == f"gate moves from {before.node} to {other}"
        until(lambda: fleet.status().streams["gate"].token > before.token)
        until(lambda: fleet.status().streams["gate"].node == other)
        later = next(track for track in tracks if track.time > first.time + 1)
    assert (later.object, later.seq > first.seq) == ("anna", True)


def test_a_stream_of_a_dead_node_continues_and_the_node_comes_back(home, site, until):
    fleet, spec = site
    fleet.move("gate", "node-2")
    until(lambda: (found := fleet.status().streams["gate"]).node == "node-2" and found.state == "running")
    until(lambda: (state := Store(spec.store).stream("gate").newest()) is not None and state.facts["seq"] > 5)
    before = fleet.status().streams["gate"]
    raylets(home / "site")["node-2"].kill()
    until(lambda: (found := fleet.status().streams["gate"]).token > before.token and found.state == "running")
    after = fleet.status().streams["gate"]
    assert after.frame > before.frame, "numbers go on after what was lost"
    assert after.lost_frames > 0
    until(lambda: fleet.status().nodes["node-2"].state == "alive")


def test_a_controller_that_dies_is_started_again_and_streams_run_on(home, site, until):
    def controllers():
        keeper = psutil.Process(int((home / "site" / "pid").read_text()))
        with suppress(psutil.Error):  # one of them has ended
            return {process.pid for process in keeper.children(recursive=True) if "Controller" in process.name()}
        return set()

    fleet, _ = site
    until(lambda: fleet.status().streams["gate"].state == "running")
    before = fleet.status().streams["gate"].token
    ray = import_module("ray")
    dead = until(controllers)
    ray.kill(fleet._controller, no_restart=False)
    until(lambda: (found := controllers()) and not found & dead)
    until(lambda: fleet.status().streams["gate"].state == "running")
    assert fleet.status().streams["gate"].token == before
    with Registry("site", timeout=60) as registry:
        until(lambda: registry.streams().streams["gate"].token == before)


def test_processes_of_the_nodes_have_the_priority_of_the_process_that_starts_them(site):
    site[0].status()  # it is connected
    ray = import_module("ray")
    theirs = ray.get(ray.remote(num_cpus=0)(lambda: os.getpriority(os.PRIO_PROCESS, 0)).remote())
    assert theirs == os.getpriority(os.PRIO_PROCESS, 0)


@pytest.mark.usefixtures("site")
def test_each_node_has_a_start_server_before_there_is_a_stream_for_it(home, until):
    def nodes_of_servers():
        servers = [process for process in psutil.process_iter() if process.name() == "start server"]
        return {int(process.environ().get("RAY_RAYLET_PID", 0)) for process in servers}

    until(lambda: {process.pid for process in raylets(home / "site").values()} <= nodes_of_servers())


def test_what_cannot_be_done_is_refused_and_nothing_is_changed(site, until):
    fleet, spec = site
    with pytest.raises(FleetError, match="gate needs 4 cores, and the largest node"):
        fleet.add(replace(spec.streams["gate"], cores=4.0))
    with pytest.raises(FleetError, match="cam-9 needs a node with site=north"):
        fleet.add(StreamSpec("cam-9", LIVE, labels={"site": "north"}))
    with pytest.raises(FleetError, match="no stream 'cam-8'"):
        fleet.move("cam-8", "node-1")
    with pytest.raises(FleetError, match="no node 'node-9'"):
        fleet.move("gate", "node-9")
    until(lambda: fleet.status().streams["film"].state == "ended")
    with pytest.raises(FleetError, match="film has ended"):
        fleet.move("film", "node-1")
    assert set(fleet.status().streams) == {"film", "gate"}


def test_a_stream_whose_source_cannot_be_opened_has_failed_until_it_is_changed_and_its_log_is_there(site, until):
    fleet, _ = site
    fleet.add(StreamSpec("cam-8", "missing.mp4", cores=0.1))
    until(lambda: (found := fleet.status().streams["cam-8"]).state == "failed" and "missing.mp4" in found.trouble)
    assert any("missing.mp4" in line for line in fleet.logs("cam-8"))
    fleet.add(StreamSpec("cam-8", LIVE, cores=0.1))
    until(lambda: fleet.status().streams["cam-8"].state in ("waiting", "running"))
    assert fleet.remove("cam-8", forget=True) == ["cam-8: is removed"]
    until(lambda: Store(site[1].store).stream("cam-8").newest() is None)


def test_a_node_that_is_drained_gives_its_streams_away(site, until):
    fleet, _ = site
    until(lambda: fleet.status().streams["gate"].state == "running")
    node = fleet.status().streams["gate"].node
    assert fleet.drain(node).startswith(f"{node} is draining; ")
    until(lambda: (found := fleet.status().streams["gate"]).node not in ("", node) and found.state == "running")
    other = fleet.status().streams["gate"].node
    fleet.drain(other)
    until(
        lambda: (found := fleet.status().streams["gate"]).state == "unplaced" and f"{node} (drained)" in found.trouble
    )
    assert fleet.drain(node, undo=True) == f"{node} takes streams again"
    until(lambda: (found := fleet.status().streams["gate"]).node == node and found.state == "running")
    fleet.drain(other, undo=True)


def test_a_merge_runs_on_nodes_whose_cores_are_all_reserved(site, until):
    fleet, spec = site
    until(lambda: fleet.status().streams["film"].state == "ended")
    fleet.add(StreamSpec("full", LIVE, cores=0.8))  # on the node without the gate: no core is free as a whole
    until(lambda: fleet.status().streams["full"].state == "waiting")
    merged = fleet.merge("film")
    fleet.remove("full", forget=True)
    assert merged.streams == ("film",)
    assert Store(spec.store).model("").newest().files["model"] == merged.model
    with pytest.raises(FleetError, match="no stream has learned of 'nobody'"):
        merge_streams(spec.store, ["film"], "nobody", named=False)


@pytest.mark.usefixtures("home")
def test_a_fleet_that_does_not_run_cannot_be_ended():
    with pytest.raises(FleetError, match="no fleet 'other' of yours runs"):
        Fleet(name="other").down()


@pytest.mark.usefixtures("home")
def test_a_fleet_whose_nodes_start_is_said_to_start(monkeypatch):
    monkeypatch.setattr(LocalCluster, "running", True)
    with pytest.raises(FleetError, match="the fleet early is starting"):
        Fleet(name="early").down()


def test_a_store_that_cannot_be_used_is_said_before_anything_starts(home, tmp_path):
    (tmp_path / "file").write_text("")
    spec = FleetSpec("nowhere", str(tmp_path / "file" / "store"), streams={"a": StreamSpec("a", LIVE)})
    with pytest.raises(StoreError, match="cannot be created"):
        Fleet(spec).up()
    assert not LocalCluster(home / "nowhere").running


def test_two_ups_at_once_start_one_fleet_under_the_name_of_the_option_and_ctrl_c_ends_it(home, tmp_path, until):
    file = tmp_path / "fleet.toml"
    file.write_text(f'[streams.gate]\nsource = "{LIVE}"\nbox = [184, 88, 57, 58]\ncores = 0.2\n')
    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(lambda _: run("fleet", "up", file, "--name", "other", "--detach"), range(2)))
    assert [each.returncode for each in done] == [0, 0], done
    assert sorted(each.stdout.splitlines()[0] for each in done) == ["gate: is added", "gate: is unchanged"]
    assert list(json.loads(run("fleet", "status", "--fleet", "other", "--json").stdout)["streams"]) == ["gate"]
    assert run("fleet", "down", "--name", "other").stdout == "the fleet other is down\n"
    assert not LocalCluster(home / "other").running
    words = command("fleet", "up", file, "--name", "other")
    with subprocess.Popen(words, env=environment(), stdout=subprocess.PIPE, text=True) as attached:
        until(lambda: "other" in fleets())
        with Registry("other", timeout=60) as registry:
            until(lambda: registry.streams().streams["gate"].state == "running")
        attached.send_signal(signal.SIGINT)
        output = attached.communicate(timeout=120)[0]
    assert (attached.returncode, output.splitlines()[-1]) == (0, "the fleet other is down")
    assert not LocalCluster(home / "other").running
