"""Tries to reach a fleet as a stranger: without a token, with a wrong one, and from another machine.

The calls are all gRPC methods that the programs of Ray name (lists of nodes, the key-value store, jobs, pushing tasks),
with an empty message, and the HTTP routes of its agent, at each port of a fleet on this machine. As root, there are
a head and a node in network namespaces, and the stranger scans all of their ports from a namespace of its own.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import re
import secrets
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from importlib.util import find_spec
from pathlib import Path
from time import monotonic, sleep

sys.path.append(str(Path(__file__).parents[1]))  # shared modules of the benchmarks

from hosts import Hosts
from ports import Port, listening
from table import Table, command, publish

from catstream.errors import FleetError
from catstream.fleet import cluster
from catstream.fleet.local import LocalFleet

SECONDS = 3.0  # for each call
SYNC = "/ray.rpc.syncer.RaySyncer/StartSync"  # checks no token, and ends a process that it reaches; see the last column
_METHOD = re.compile(rb"/(?:ray\.rpc|grpc\.(?:health|reflection))\.[\w.]+/\w+")
_ROUTES = ("/", "/get_or_create_runtime_env", "/delete_runtime_env_if_possible", "/get_runtime_envs_info", "/api/jobs/")
_HARMLESS = "NodeInfoGcsService/GetAllNodeInfo", "NodeManagerService/GetNodeStats", "CoreWorkerService/NumPendingTasks"
_REFUSED = {"16": "refused", "401": "refused", "403": "refused", "12": "no such service"}  # states of gRPC and HTTP
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_DATA, _HEADERS, _RESET, _SETTINGS, _GOODBYE = 0, 1, 3, 4, 7  # types of frames
_END_STREAM, _END_HEADERS = 1, 4
_SCANNED = range(1024, 65536)


def methods() -> list[str]:
    """All gRPC methods that the programs of Ray name."""
    package = find_spec("ray")
    assert package is not None, "Ray is not installed"
    assert package.origin is not None
    folder = Path(package.origin).parent
    programs = [*folder.glob("core/src/ray/*/raylet"), *folder.glob("core/src/ray/*/gcs_server"), folder / "_raylet.so"]
    found = {name.decode() for path in programs for name in _METHOD.findall(path.read_bytes())}
    return sorted(found - {SYNC} | {"/grpc.health.v1.Health/Check"})


def grpc(host: str, port: int, method: str, token: str | None) -> tuple[str, int]:
    """Call a method with an empty message, on a connection of its own; return the gRPC status and the bytes received.

    A status is plain text in the header of a server that uses gRPC's own library; "" if there is none.
    """
    fields = {":method": "POST", ":scheme": "http", ":path": method, ":authority": f"{host}:{port}"}
    fields |= {"te": "trailers", "content-type": "application/grpc"}
    if token is not None:
        fields["authorization"] = f"Bearer {token}"
    header = b"".join(b"\0" + _text(name) + _text(value) for name, value in fields.items())
    status, size = "", 0
    with suppress(OSError), socket.create_connection((host, port), SECONDS) as stream, stream.makefile("rb") as replies:
        data = _frame(_DATA, _END_STREAM, 1, bytes(5))  # not compressed, of length 0
        stream.sendall(_PREFACE + _frame(_SETTINGS, 0, 0, b"") + _frame(_HEADERS, _END_HEADERS, 1, header) + data)
        while len(head := replies.read(9)) == 9:
            kind, flags, body = head[3], head[4], replies.read(int.from_bytes(head[:3]))
            if kind == _HEADERS and (found := re.search(rb"grpc-status.(\d+)", body, re.DOTALL)):
                status = found[1].decode()
            size += len(body) if kind == _DATA else 0
            if kind in (_RESET, _GOODBYE) or (kind in (_DATA, _HEADERS) and flags & _END_STREAM):
                break
    return status, size


def web(host: str, port: int, route: str, token: str | None) -> tuple[str, int]:
    """Post to an HTTP route; return the status, and the bytes received if it is not an error."""
    with (
        suppress(OSError, http.client.HTTPException),
        closing(http.client.HTTPConnection(host, port, SECONDS)) as client,
    ):
        client.request("POST", route, b"{}", {} if token is None else {"Authorization": f"Bearer {token}"})
        reply = client.getresponse()
        return str(reply.status), len(reply.read()) if reply.status < 400 else 0
    return "", 0


def outcomes(host: str, port: Port, token: str | None) -> dict[str, tuple[str, int]]:
    """Status and bytes of each method or route that is not refused at a port."""
    call, paths = (web, list(_ROUTES)) if "RuntimeEnv" in port.process else (grpc, methods())
    with ThreadPoolExecutor(16) as pool:
        replies = pool.map(lambda path: call(host, port.number, path, token), paths)
    return {path: reply for path, reply in zip(paths, replies, strict=True) if reply[0] not in _REFUSED or reply[1]}


def answers_friends(host: str, port: Port, token: str) -> bool:
    """Whether the port answers the right token, in a call that does nothing."""
    calls = [grpc(host, port.number, f"/ray.rpc.{name}", token) for name in _HARMLESS]
    route = web(host, port.number, "/get_runtime_envs_info", token)
    return any(status == "0" for status, _ in calls) or route[0] not in ("", "401", "403")


def _text(text: str) -> bytes:
    """A text in a header, not compressed."""
    assert len(text) < 127
    return bytes([len(text)]) + text.encode()


def _frame(kind: int, flags: int, stream: int, body: bytes) -> bytes:
    return len(body).to_bytes(3) + bytes([kind, flags]) + stream.to_bytes(4) + body


def survives_sync(host: str, port: Port, token: str) -> str:
    """Return the effect of a call of `SYNC` without a token on the process at a port."""
    status, _ = grpc(host, port.number, SYNC, None)
    sleep(0.5)
    alive = grpc(host, port.number, "/grpc.health.v1.Health/Check", token)[0] == "0"
    return _REFUSED.get(status, "answered") if alive else "the process ends"


def _row(host: str, node: str, port: Port, token: str) -> tuple[object, ...]:
    calls = len(_ROUTES) if "RuntimeEnv" in port.process else len(methods())
    got = [outcomes(host, port, each) for each in (None, secrets.token_hex(32))]
    shown = ["; ".join(sorted({path.split("/")[1] for path in found})) or "nothing" for found in got]
    friend = "answers" if answers_friends(host, port, token) else "other services"
    return node, port.address, port.process, calls, *shown, friend


def on_this_machine() -> Table:
    """Every call at every port of a local fleet with an actor, on its loopback address."""
    with tempfile.TemporaryDirectory(prefix="catstream-") as folder:
        fleet = LocalFleet(Path(folder) / "fleet")
        fleet.start(1)
        try:
            cluster.connect(fleet.address, fleet.token_file)
            actor = _start_actor()
            token = cluster.read_token(fleet.token_file)
            found = [(name, port) for name in ("node-1", "head") for port in listening(fleet, name)]
            rows = [_row("127.0.0.1", name, port, token) for name, port in found]
            order = ["ray::Actor", "raylet", "gcs_server"]  # the end of the head is the end of its actor
            asked = [(name, port) for name, port in found if name == "node-1" or port.process != "raylet"]
            asked = [each for each in asked if each[1].process in order]
            asked.sort(key=lambda each: (order.index(each[1].process), answers_friends("127.0.0.1", each[1], token)))
            syncs = {port: survives_sync("127.0.0.1", port, token) for _, port in asked}
            del actor
            cluster.disconnect()
        finally:
            fleet.stop()
    return Table(
        "A fleet on this machine: calls that were not refused",
        ("node", "listens at", "process", "calls", "without a token", "wrong token", "right token", "StartSync"),
        [(*row, syncs.get(port, "")) for row, (_, port) in zip(rows, found, strict=True)],
        "grpc.health says that the process is alive, grpc.reflection names the services of Ray. StartSync was called "
        "last, without a token; the keeper starts Ray again",
    )


def _start_actor() -> object:
    import ray

    @ray.remote(num_cpus=0)
    class Actor:
        def ping(self) -> bool:
            return True

    actor = Actor.remote()
    ray.get(actor.ping.remote())
    return actor


def from_another_machine() -> Table:
    """The ports of a head and a node that a third machine of their network reaches."""
    rows = []
    main = "from catstream.cli import main; main()"
    with tempfile.TemporaryDirectory(prefix="catstream-") as folder, Hosts("head", "node", "stranger") as hosts:
        state, address = Path(folder), hosts.addresses
        log = (state / "log").open("w+")

        def keep(name: str, *words: object) -> None:
            hosts.start(name, sys.executable, "-P", "-c", main, "fleet", *words, stdout=log, stderr=log)

        keep("head", "head", "--listen", f"{address['head']}:6400", "--folder", state / "head")
        _await(log.name, "listens at")
        token = state / "head" / "token"
        keep("node", "node", "--head", f"{address['head']}:6400", "--token-file", token, "--folder", state / "node")
        _await(log.name, "has joined")
        for name in ("head", "node"):
            scan = [sys.executable, __file__, "--scan", address[name]]
            done = hosts.start("stranger", *scan, stdout=subprocess.PIPE)
            opened = json.loads(done.communicate()[0])
            rows.append((name, address[name], len(_SCANNED), " ".join(map(str, opened))))
        log.close()
    return Table(
        "Ports that another machine of the private network reaches",
        ("machine", "address", "scanned", "open"),
        rows,
        "6400 is the head; from 6401 the raylet, its agent and workers (--ports). A firewall closes them to others",
    )


def _await(path: str, line: str) -> None:
    deadline = monotonic() + 120
    while line not in Path(path).read_text():
        if monotonic() > deadline:
            raise FleetError(f"no line {line!r} in time: {Path(path).read_text()[-500:]}")
        sleep(0.1)


def scan(host: str) -> list[int]:
    """The ports of a host that accept a connection."""

    def accepts(port: int) -> bool:
        with socket.socket() as probe:
            probe.settimeout(SECONDS)
            return probe.connect_ex((host, port)) == 0

    with ThreadPoolExecutor(64) as pool:
        return [port for port, is_open in zip(_SCANNED, pool.map(accepts, _SCANNED), strict=True) if is_open]


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """The tables of this machine, and as root those of namespaces."""
    del options
    yield on_this_machine()
    if os.geteuid() == 0:
        yield from_another_machine()


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("--scan", metavar="HOST", help="print the open ports of a host, and end")
    options = parser.parse_args()
    if options.scan:
        print(json.dumps(scan(options.scan)))
    else:
        publish(tables(options), options)
