"""The process that keeps the nodes of a cluster on one machine, with a cluster that starts no process of Ray."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from catstream.errors import FleetError
from catstream.fleet import local
from catstream.fleet.fleet import Fleet
from catstream.fleet.local import LocalCluster
from catstream.fleet.spec import FleetSpec


class FakeNode:
    def __init__(self):
        self.dead = False

    def dead_processes(self):
        return [("raylet", None)] if self.dead else []


class FakeCluster:
    """Cannot start the third node that it is asked for at the first attempt, and leaves a process of it."""

    address = "127.0.0.1:1"

    def __init__(self, **_):
        self.head_node, self.added, self.failures, self.half_started = FakeNode(), [], 1, None

    def add_node(self, *, node_name, **_):
        if len(self.added) == 2 and self.failures:
            self.failures -= 1
            self.half_started = subprocess.Popen(["sleep", "100"])
            raise TimeoutError("The current node timed out during startup.")
        self.added.append(node_name)
        return FakeNode()

    def remove_node(self, node, allow_graceful):
        assert node.dead
        assert not allow_graceful

    def shutdown(self):
        pass


@pytest.fixture
def cluster(monkeypatch):
    cluster = FakeCluster()
    monkeypatch.setattr("ray.cluster_utils.Cluster", lambda **_: cluster)
    monkeypatch.setattr(local, "NODES_SECONDS", 0.01)
    return cluster


def test_a_node_that_does_not_start_again_at_once_is_tried_again_and_leaves_no_process(
    cluster, tmp_path, until, capfd, monkeypatch
):
    nodes = []
    add = cluster.add_node
    monkeypatch.setattr(cluster, "add_node", lambda **options: nodes.append(add(**options)) or nodes[-1])
    ends = threading.Event()
    keeper = threading.Thread(target=local._keep, args=(tmp_path, 3, 1, ends))
    keeper.start()
    until(lambda: len(nodes) == 2)
    nodes[1].dead = True
    until(lambda: len(nodes) == 3)
    ends.set()
    keeper.join()
    assert cluster.added == ["node-2", "node-3", "node-3"]
    assert cluster.half_started.wait(5) < 0
    assert "node-3 does not start: The current node timed out" in capfd.readouterr().out


def test_a_head_that_dies_ends_the_cluster_and_says_so(cluster, tmp_path, capfd):
    cluster.head_node.dead = True
    local._keep(tmp_path, 1, 1, threading.Event())
    assert capfd.readouterr().out == "the head, node-1, has died\n"


@pytest.mark.parametrize(("code", "died"), [(0, False), (1, False), (local._DIED, True), (-9, True)])
def test_a_cluster_that_ended_by_itself_is_told_from_one_that_was_ended(tmp_path, monkeypatch, code, died):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    fleet = Fleet(FleetSpec("site", str(tmp_path / "store")))
    folder = Path(tmp_path, "catstream", "fleets", "site")
    folder.mkdir(parents=True)
    (folder / "log").write_text("Traceback ...\nthe head, node-1, has died\n")
    fleet._local = LocalCluster(folder)
    end = f"import os, signal; os.kill(os.getpid(), signal.SIGKILL) if {code} < 0 else os._exit({code})"
    fleet._local._process = subprocess.Popen([sys.executable, "-c", end])
    fleet._local._process.wait()
    if died:
        with pytest.raises(FleetError, match=r"the fleet site has died with Ray.*: the head, node-1, has died\nSee "):
            assert fleet.is_running
    else:
        assert not fleet.is_running
