"""A subscriber that uses pyzmq and msgpack, without importing catstream.

    catstream track walk.mp4 --box 120,80,64,48 --set run.endpoint=run
    python examples/subscriber.py run

If the pipeline requires keys, give their folder as the second argument.

Prints every track and each new model, with the name of its object, until the pipeline ends. `docs/protocol.md`
describes the messages.
"""

from __future__ import annotations

import math
import sys
import tomllib
from array import array
from pathlib import Path
from typing import Any

import msgpack
import zmq

PORTS = {"models": 2, "tracks": 3}  # offset from the port of the endpoint


def address(endpoint: str, channel: str) -> str:
    """Return the address of a channel; the endpoint is a folder of sockets, or tcp://127.0.0.1:PORT."""
    if endpoint.startswith("tcp://"):
        host, _, port = endpoint.rpartition(":")
        return f"{host}:{int(port) + PORTS[channel]}"
    return f"ipc://{endpoint}/{channel}"


def attach(endpoint: str, channel: str, keys: str) -> zmq.Socket[bytes]:
    """Return a socket that subscribes to a channel."""
    socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.SUB)
    socket.subscribe(b"")
    if keys:
        own = tomllib.loads((Path(keys) / "client.key").read_text())
        socket.curve_serverkey = tomllib.loads((Path(keys) / "server.pub").read_text())["public"].encode()
        socket.curve_publickey, socket.curve_secretkey = own["public"].encode(), own["secret"].encode()
    socket.connect(address(endpoint, channel))  # the pipeline may start later
    return socket


def receive(socket: zmq.Socket[bytes]) -> tuple[str, dict[str, Any]]:
    """Receive the next message: its kind and its fields."""
    version, kind, _, _, fields = msgpack.unpackb(socket.recv())
    if version != 5:
        sys.exit("this catstream speaks another protocol")
    return kind, fields


def norm(weights: dict[str, Any]) -> float:
    """Return the Euclidean norm of an encoded vector: dtype "<f4", shape, and bytes."""
    numbers = array("f", weights["data"])
    if sys.byteorder == "big":
        numbers.byteswap()
    return math.hypot(*numbers)


def main(endpoint: str, keys: str = "") -> None:
    tracks, models = attach(endpoint, "tracks", keys), attach(endpoint, "models", keys)
    poller = zmq.Poller()
    poller.register(tracks)
    poller.register(models)
    expected = missed = 0  # number of the next frame
    versions: dict[str, int] = {}  # of the last model of each object
    while True:
        ready = dict(poller.poll())
        if models in ready:
            _, model = receive(models)
            name, version = model["object"], model["version"]
            if versions.get(name) != version:  # the last model may arrive twice
                versions[name] = version
                length = f"norm {norm(model['weights']):.4f}"
                print(f"model {version} of frame {model['frame']}, {length} {name}".rstrip(), flush=True)
        if tracks in ready:
            kind, track = receive(tracks)
            if expected:  # tracks before the first received one are not counted
                missed += max(0, track["frame"] - expected)
            expected = track["frame"] + 1
            if kind == "end":
                print(f"end: {track['reason']}, {missed} tracks missed")
                return
            box = "-" if track["box"] is None else ",".join(f"{side:.1f}" for side in track["box"])
            line = f"track {track['frame']} {track['state']} {box} {track['score']:.3f} {track['object']}"
            print(line.rstrip(), flush=True)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit("usage: python subscriber.py ENDPOINT [KEYS] (a folder, or tcp://127.0.0.1:PORT; a folder of keys)")
    main(*sys.argv[1:])
