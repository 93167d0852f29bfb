"""Features a second from one process to another, each message acknowledged: over Unix sockets and over tcp."""

from __future__ import annotations

import argparse
import multiprocessing
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

import numpy as np
from table import Table, command, publish

from catstream.box import Box
from catstream.detection.hog import row_length
from catstream.messages import End, Features, Position
from catstream.settings import Settings
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint, private_folder
from catstream.wire.sockets import Receiver, Sender

WINDOW = Settings().window


def figures(options: argparse.Namespace) -> Iterator[Table]:
    rows = []
    for kind, place in (("ipc", folder), ("tcp", loopback)):
        for k in (25,) if options.quick else (1, 25):
            with place() as endpoint:
                messages = (200 if options.quick else options.messages) // (1 if k == 1 else 4)
                seconds, size = delivered(endpoint, messages, k)
            rate = messages / seconds
            rows.append((kind, k, size / 1e3, rate, rate * k, rate * size / 1e6))
    columns = ("over", "rows a message", "kB a message", "messages/s", "rows/s", "MB/s")
    note = f"acknowledged one by one, at most {WINDOW} on the way; a frame is a message, usually of about 25 rows"
    yield Table("Features, sent and acknowledged", columns, rows, note)


@contextmanager
def folder() -> Iterator[str]:
    with private_folder() as path:
        yield str(path)


@contextmanager
def loopback() -> Iterator[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1] - CHANNELS["features"].port
    yield f"tcp://127.0.0.1:{port}"


def delivered(endpoint: str, messages: int, k: int) -> tuple[float, int]:
    """Seconds until the last of some messages is acknowledged, and bytes of rows in each."""
    receiver = multiprocessing.get_context("spawn").Process(target=receive, args=(endpoint,), daemon=True)
    receiver.start()
    rows = np.random.default_rng(0).random((k, row_length()), np.float32)
    ones = np.ones(k, np.float32)
    with Sender("features", Endpoint.parse(endpoint), WINDOW) as sender:
        while sender.position() is None:  # not there yet
            receiver.join(0.01)
        begin = perf_counter()
        for seq in range(1, messages + 1):
            while not sender.send(Features(seq, seq - 1, 0.0, Box(1, 2, 3, 4), rows, ones, ones)):
                sender.listen(0.01)
        while sender.stored < messages:
            sender.listen(0.01)
        seconds = perf_counter() - begin
        sender.send(End(messages + 1, "that was all"))
    receiver.join()
    return seconds, rows.nbytes


def receive(endpoint: str) -> None:
    """Take every message, and say so, until the end."""
    with Receiver("features", Endpoint.parse(endpoint), Position(), WINDOW) as features:
        message = None
        while not isinstance(message, End):
            message = features.receive(0.1)
            if message is not None:
                features.acknowledge(Position(message.seq))


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument(
        "--messages", type=int, default=20_000, help="of one row; a quarter of 25 rows (default: %(default)s)"
    )
    options = parser.parse_args()
    publish(figures(options), options.json)
