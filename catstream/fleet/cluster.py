"""The cluster of Ray on which a fleet runs: connect to it, and see its nodes.

Ray is started by its users: `ray start`, KubeRay, a service of a cloud. `catstream.fleet.local` starts it on one
machine. Its variables are Ray's own: RAY_ADDRESS, RAY_AUTH_MODE=token and RAY_AUTH_TOKEN_PATH.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
import warnings
from collections.abc import Mapping

from catstream.errors import FleetError, require_extra
from catstream.fleet.life import Node
from catstream.fleet.timing import REACH_SECONDS

#: Namespace of the named actors of all fleets.
NAMESPACE = "catstream"


def connect(address: str, variables: Mapping[str, str] | None = None) -> None:
    """Connect this process to the cluster at an address. It does nothing if it is connected to this cluster already.

    Parameters
    ----------
    address : HOST:PORT of the head
    variables : set in the environment of this process before Ray is imported

    Raises
    ------
    FleetError
        If nothing answers there, the token is refused, this machine is no node of the cluster, or this process is
        connected to another one.
    MissingExtraError
        If Ray is not installed.
    """
    require_extra("fleet")
    changed = {name: value for name, value in (variables or {}).items() if os.environ.get(name) != value}
    if changed and "ray" in sys.modules:  # which reads its variables once
        raise FleetError("this process has used Ray before with other settings: a process uses one cluster only")
    os.environ.update(changed)
    os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", "2")  # of 41 s each if the head dies now; Ray's default is 20
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), REACH_SECONDS).close()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or "no answer"
        raise FleetError(
            f"there is no cluster of Ray at {address!r} ({why}): expected HOST:PORT as `ray start --head` prints it"
        ) from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Ray, about its own future
        import ray

        if ray.is_initialized():
            if (other := ray.get_runtime_context().gcs_address) != address:
                raise FleetError(f"this process is connected to the cluster at {other}: it can use one cluster only")
            return
        try:
            ray.init(address, namespace=NAMESPACE, log_to_driver=False, logging_level=logging.ERROR)
        except (ray.exceptions.RayError, ConnectionError, RuntimeError, ValueError) as error:
            why = str(error).strip().partition("\n")[0]
            raise FleetError(
                f"cannot connect to the cluster of Ray at {address}: {why}\nThis machine has to be a node of it (`ray "
                "start --address ...`), with the same versions of Python and Ray, and its token (RAY_AUTH_MODE=token, "
                "RAY_AUTH_TOKEN_PATH)"
            ) from None


def disconnect() -> None:
    """Disconnect this process from the cluster; the fleet runs on."""
    ray = sys.modules.get("ray")
    if ray is not None:
        ray.shutdown()


def is_local() -> bool:
    """Whether the connected cluster is on the loopback interface, so that all its clients are on this machine."""
    import ray

    host: str = ray.get_runtime_context().gcs_address.rpartition(":")[0]
    return host in ("127.0.0.1", "localhost", "::1")


def actor_name(fleet: str, kind: str, stream: str = "") -> str:
    """The name of an actor: of the controller, or of a stream.

    >>> actor_name("site", "stream", "cam-7"), actor_name("site", "controller")
    ('site/stream/cam-7', 'site/controller')
    """
    return "/".join(filter(None, (fleet, kind, stream)))


def actors(fleet: str) -> set[str]:
    """The streams of a fleet that have an actor."""
    prefix = actor_name(fleet, "stream") + "/"
    return {name.removeprefix(prefix) for name in _names() if name.startswith(prefix)}


def fleets() -> list[str]:
    """The fleets that have a controller."""
    return sorted(name.removesuffix("/controller") for name in _names() if name.endswith("/controller"))


def _names() -> list[str]:
    from ray.util import list_named_actors

    return [each["name"] for each in list_named_actors(all_namespaces=True) if each["namespace"] == NAMESPACE]


def nodes() -> list[Node]:
    """The nodes of the connected cluster by name.

    A node that was started again appears once. A dead node appears as long as no living node has its name.
    """
    import ray

    found: dict[str, Node] = {}
    for entry in ray.nodes():
        node = Node(
            entry["NodeName"] or entry["NodeManagerAddress"],
            entry["NodeID"],
            entry["NodeManagerAddress"],
            float(entry["Resources"].get("CPU", 0.0)),
            {key: value for key, value in (entry.get("Labels") or {}).items() if not key.startswith("ray.io/")},
            entry["Alive"],
        )
        before = found.get(node.name)
        if before is not None and before.alive and node.alive:  # two machines with one name
            found[node.id[:12]] = node
        elif before is None or node.alive:
            found[node.name] = node
    return sorted(found.values(), key=lambda node: node.name)
