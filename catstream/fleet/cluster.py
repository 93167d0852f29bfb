"""The Ray cluster of a fleet: the environment of its processes, the connection of a driver, the facts of its nodes.

Ray lets everybody who connects run code on all nodes. So each process of a cluster has the fleet's token
(`environment`), nothing connects to a cluster that asks for none, and its addresses are private ones.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import os
import platform
import re
import secrets
import socket
import subprocess
import sys
import warnings
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from catstream.errors import FleetError, UnreachableError
from catstream.extras import require_extra
from catstream.services import start

__all__ = [
    "HEAD_RESOURCE",
    "NAMESPACE",
    "PREFIX",
    "NodeFacts",
    "child_environment",
    "connect",
    "disconnect",
    "environment",
    "label_value",
    "make_token",
    "nodes",
    "private_address",
    "probe",
    "read_token",
    "stay_on_loopback",
    "versions",
]

#: Namespace of the named actors of a fleet.
NAMESPACE = "catstream"
#: Custom resource of the head: an actor that takes some of it runs there.
HEAD_RESOURCE = "catstream-head"
#: Prefix of the labels that `catstream fleet node` gives to a node. All others are the user's, or Ray's own.
PREFIX = "catstream/"

#: Variables of the processes on the head: the folder of the fleet, and where the registry listens.
FOLDER_VARIABLE, REGISTRY_VARIABLE = "CATSTREAM_FLEET_FOLDER", "CATSTREAM_FLEET_REGISTRY"

_LOOPBACK = "127.0.0.1"
_PRIVATE = [ipaddress.IPv4Network(network) for network in ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16")]
_PROBE_SECONDS = 15.0
_REACH_SECONDS = 3.0
_SHORTEST_TOKEN = 32  # characters

#: Variables of all processes of a cluster. A dead node is noticed after 2 seconds, a frozen one after 6.
_ALWAYS = {
    "RAY_AUTH_MODE": "token",
    "RAY_health_check_initial_delay_ms": "1000",
    "RAY_health_check_period_ms": "500",
    "RAY_health_check_timeout_ms": "1500",
    "RAY_health_check_failure_threshold": "3",
    "RAY_gcs_rpc_server_reconnect_timeout_s": "3600",  # nodes and drivers wait for a head that restarts
    "RAY_raylet_start_wait_time_s": "60",
    "RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S": "0",  # a node that is stopped ends at once
    "RAY_worker_niceness": "0",  # the default, 15, starves the streams of a node on which other work runs
    "RAY_prestart_worker_first_driver": "0",  # a process is started if an actor needs it
    "RAY_OBJECT_STORE_ALLOW_SLOW_STORAGE": "1",  # no warning about a small /dev/shm: frames are not stored in Ray
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_DEDUP_LOGS": "0",
}


def environment(token_file: Path, gcs_folder: Path | None = None) -> dict[str, str]:
    """Return the variables for a process of the cluster, to be added to its environment before Ray is imported.

    Parameters
    ----------
    token_file : file with the token of the fleet
    gcs_folder : for the head: folder of the cluster's state, from which a head that was restarted continues
    """
    variables = _ALWAYS | {"RAY_AUTH_TOKEN_PATH": str(token_file.absolute())}
    if gcs_folder is not None:
        variables |= {"RAY_gcs_storage": "rocksdb", "RAY_gcs_storage_path": str(gcs_folder.absolute())}
    return variables


def child_environment(token_file: Path, gcs_folder: Path | None = None) -> dict[str, str]:
    """Return all variables for a child process that uses Ray: those of the user that concern Ray are left out."""
    others = {name: value for name, value in start.environment().items() if not name.startswith("RAY_")}
    return others | environment(token_file, gcs_folder)


def versions() -> dict[str, str]:
    """Return the versions that have to be equal on all nodes: of catstream, Python and Ray."""
    return {"catstream": version("catstream"), "python": platform.python_version(), "ray": version("ray")}


def make_token(path: Path) -> None:
    """Make a token of 256 bits in a file that only this user may read, if the file does not exist."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return
    with os.fdopen(handle, "w") as file:
        file.write(secrets.token_hex(32))


def read_token(path: Path) -> str:
    """Return the token in a file.

    Raises
    ------
    FleetError
        If there is no such file, other users can access it, or it does not contain a token.
    """
    try:
        facts, token = path.stat(), path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise FleetError(
            f"cannot read the token of the fleet in {path} ({getattr(error, 'strerror', None) or 'not a text'}): copy "
            "the file `token` from the folder of the head, mode 600"
        ) from None
    if facts.st_uid not in (os.geteuid(), 0) or facts.st_mode & 0o077:
        raise FleetError(
            f"other users can access the token in {path}: chmod 600, and make a new one if somebody may have read it"
        )
    if len(token) < _SHORTEST_TOKEN or not token.isascii():
        raise FleetError(
            f"{path} does not contain the token of a fleet, which has {_SHORTEST_TOKEN} characters or more: "
            "copy the file `token` from the folder of the head"
        )
    return token


def private_address(text: str) -> tuple[str, int]:
    """Return host and port of a text IP:PORT.

    Raises
    ------
    FleetError
        If the address is not 127.0.0.1 or in a private IPv4 network: everybody who has the token can run code on all
        nodes, so nobody else should reach the ports of Ray at all.
    """
    host, _, port = text.rpartition(":")
    try:
        address = ipaddress.IPv4Address(host)
        if not (port.isascii() and port.isdecimal() and 1024 <= int(port) <= 65535):
            raise ValueError
    except ValueError:
        raise FleetError(f"expected an IPv4 address and a port above 1023, as in 10.0.0.1:6400, got {text!r}") from None
    if address.is_loopback and host != _LOOPBACK:
        raise FleetError(f"Ray would listen on all interfaces for {host}: use {_LOOPBACK}:{port} on a single machine")
    if host != _LOOPBACK and not any(address in network for network in _PRIVATE):
        raise FleetError(
            f"{host} is not a private address: the nodes of a fleet are connected by a private network or a VPN "
            f"({', '.join(map(str, _PRIVATE))}), or run on one machine ({_LOOPBACK})"
        )
    return host, int(port)


def stay_on_loopback() -> None:
    """Make Ray use the address 127.0.0.1 as it is given.

    Ray replaces it by an address of the machine, and listens on all interfaces for any other address than 127.0.0.1.
    Without the replacement, all ports of a cluster on one machine are on the loopback interface only.
    """
    from ray._private import services

    services.resolve_ip_for_localhost = lambda host: _LOOPBACK if host == "localhost" else host


def _print_nothing() -> None:
    """Keep Ray from writing to the standard output of a command when a node dies."""
    worker: Any = import_module("ray._private.worker")
    worker.print_to_stdstream = lambda *_, **__: None


@dataclass(frozen=True, slots=True)
class NodeFacts:
    """A node of the cluster as Ray knows it.

    name      as given to `catstream fleet node`; unique among the living nodes
    id        of Ray; a node that was restarted has a new one
    address   its IP address
    cores     for streams; 0 for the head
    labels    as given to `catstream fleet node`
    alive     whether it answers Ray's health checks
    versions  of catstream, python and ray; empty for a node that was not started by `catstream fleet node`
    head      whether it is the head
    """

    name: str
    id: str
    address: str
    cores: float
    labels: dict[str, str]
    alive: bool
    versions: dict[str, str]
    head: bool = False


def nodes() -> list[NodeFacts]:
    """Return the nodes of the connected cluster by name, the head included.

    A node that was restarted appears once. A dead node appears as long as no living node has its name.
    """
    import ray

    newest: dict[str, tuple[tuple[bool, float], NodeFacts]] = {}
    for entry in ray.nodes():
        facts, since = _facts(entry)
        rank = facts.alive, since  # a killed node may count as alive for some seconds after its successor has joined
        if facts.name not in newest or newest[facts.name][0] < rank:
            newest[facts.name] = rank, facts
    return [facts for _, (_, facts) in sorted(newest.items())]


def _facts(entry: dict[str, Any]) -> tuple[NodeFacts, float]:
    """Facts of one entry of `ray.nodes()`, and the time since which it runs."""
    labels, resources = entry.get("Labels") or {}, entry.get("Resources") or {}
    ours = {key.removeprefix(PREFIX): value for key, value in labels.items() if key.startswith(PREFIX)}
    facts = NodeFacts(
        name=ours.get("node") or entry["NodeName"] or entry["NodeID"][:12],
        id=entry["NodeID"],
        address=entry["NodeManagerAddress"],
        cores=float(ours.get("cores", resources.get("CPU", 0.0))),
        labels={key: value for key, value in labels.items() if not key.startswith((PREFIX, "ray.io/"))},
        alive=entry["Alive"],
        versions={name: ours[name] for name in ("catstream", "python", "ray") if name in ours},
        head=ours.get("head") == "yes" or HEAD_RESOURCE in resources,
    )
    return facts, float(ours.get("since", 0.0))


def connect(address: str, token_file: Path) -> None:
    """Connect this process to the cluster at an address. It does nothing if it is connected to this cluster already.

    Parameters
    ----------
    address : HOST:PORT of the head
    token_file : file with the token of the fleet

    Raises
    ------
    FleetError
        If the cluster cannot be reached, refuses the token or asks for none; if a node has another version of
        catstream, Python or Ray; if this machine is not a node of the cluster.
    """
    require_extra("fleet")
    read_token(token_file)
    host, port = private_address(address)
    if _connected(f"{host}:{port}"):
        return
    if "ray" in sys.modules and os.environ.get("RAY_AUTH_MODE") != "token":
        raise FleetError(
            "Ray was imported before the fleet, without a token: use the fleet first, or start the program with "
            "RAY_AUTH_MODE=token"
        )
    found = probe(address, token_file)
    _check_versions(found)
    if not any(Path(entry["socket"]).exists() for entry in found):
        raise FleetError(
            f"this machine is not a node of the fleet at {address}: run the command on a node, or let this machine "
            f"join without cores (catstream fleet node --head {address} --token-file {token_file} --cores 0)"
        )
    os.environ.pop("RAY_AUTH_TOKEN", None)  # Ray would prefer it to the file
    os.environ.update(environment(token_file))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Ray, about its own future
        import ray

        raylet: Any = import_module("ray._raylet")
        raylet.AuthenticationTokenLoader.instance().reset_cache()  # this process may have used another fleet before
        stay_on_loopback()
        _print_nothing()
        try:
            ray.init(address, namespace=NAMESPACE, log_to_driver=False, logging_level=logging.ERROR)
        except (ray.exceptions.RayError, ConnectionError, RuntimeError, ValueError) as error:
            raise FleetError(f"cannot connect to the fleet at {address}: {_first_line(str(error))}") from None


def _connected(address: str) -> bool:
    """Whether this process is connected to the cluster at an address."""
    ray = sys.modules.get("ray")
    if ray is None or not ray.is_initialized():
        return False
    other = ray.get_runtime_context().gcs_address
    if other != address:
        raise FleetError(f"this process is connected to the fleet at {other}: a process uses one fleet at a time")
    return True


def disconnect() -> None:
    """Disconnect this process from the cluster; the fleet runs on."""
    ray = sys.modules.get("ray")
    if ray is not None:
        ray.shutdown()


def probe(address: str, token_file: Path) -> list[dict[str, Any]]:
    """Ask the head of a cluster for its living nodes, in a process of its own, within seconds.

    Returns
    -------
    list of dict
        For each node its `name`, its `labels`, and the path of the `socket` that it has on its machine.

    Raises
    ------
    UnreachableError
        If the head does not answer.
    FleetError
        If it refuses the token, or asks for none.
    """
    host, port = private_address(address)
    try:
        socket.create_connection((host, port), _REACH_SECONDS).close()
    except OSError as error:
        raise UnreachableError(
            f"nothing answers at {address} ({error.strerror or 'timed out'}): is the head running (catstream fleet "
            "head), and is this its address?"
        ) from None
    command = [sys.executable, "-P", "-m", "catstream.fleet.probe", address]
    variables = child_environment(token_file)
    try:
        done = subprocess.run(command, env=variables, capture_output=True, timeout=_PROBE_SECONDS, check=False)
        answer = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        raise UnreachableError(f"the head of the fleet does not answer at {address}: look at its log") from None
    if "refused" in answer:
        raise FleetError(
            f"the fleet at {address} refuses the token in {token_file}: copy the file `token` from its head's folder"
        )
    if "open" in answer:
        raise FleetError(
            f"the cluster at {address} asks for no token, so everybody who reaches it can run code on its nodes: start "
            "its head with `catstream fleet head`"
        )
    if "nodes" not in answer:
        raise FleetError(f"cannot ask the head of the fleet at {address}: {answer.get('error')}")
    found: list[dict[str, Any]] = answer["nodes"]
    return found


def _check_versions(found: list[dict[str, Any]]) -> None:
    """Raise a FleetError if a node has other versions than this machine."""
    for entry in found:
        for name, own in versions().items():
            other = entry["labels"].get(f"{PREFIX}{name}", own)
            if other != label_value(own):
                raise FleetError(
                    f"node {entry['name']} has {name} {other}, this machine has {own}: install the same version of "
                    f"{name} on all machines of the fleet"
                )


def label_value(text: str) -> str:
    """Return a text with the characters that Ray allows in the value of a label."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text)


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]
