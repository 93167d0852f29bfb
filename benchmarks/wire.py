"""Acknowledged features messages per second between two processes, over Unix sockets and over TCP."""

from __future__ import annotations

import argparse
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

from sequences import rendered
from table import Table, benchmark, command

from catstream.applications.workers import SPAWN
from catstream.box import Box
from catstream.detection.objects import Detectors
from catstream.features.pyramid import Pyramid
from catstream.messages.kinds import End, Features, Position
from catstream.messages.names import UNNAMED
from catstream.settings import Settings
from catstream.wire.acknowledged import Receiver, Sender
from catstream.wire.channels import CHANNELS, FEATURES
from catstream.wire.endpoint import Endpoint, private_folder

WINDOW = Settings().run.unstored_frames


def figures(options: argparse.Namespace) -> Iterator[Table]:
    features, messages = features_of_a_frame(), 50 if options.quick else options.messages
    training = features.objects[UNNAMED].training.values()
    count, megabytes = sum(map(len, training)), sum(rows.rows.nbytes for rows in training) / 1e6
    rows = []
    for kind, place in (("ipc", folder), ("tcp", loopback)):
        with place() as endpoint:
            rate = messages / delivered(endpoint, features, messages)
        rows.append((kind, count, megabytes, rate, rate * count, rate * megabytes))
    columns = ("over", "rows a message", "MB a message", "messages/s", "rows/s", "MB/s")
    note = f"a frame is a message; each is acknowledged, at most {WINDOW} are on the way"
    yield Table("Features, sent and acknowledged", columns, rows, note)


def features_of_a_frame() -> Features:
    """Return the features message of a typical frame."""
    sequence, detectors = rendered(2, (320, 240)), Detectors(Settings())
    first, second = map(Pyramid, sequence.frames())
    detectors.step(first, given={UNNAMED: detectors.begin(UNNAMED, first, Box(*sequence.boxes[0]))})
    _, features = detectors.step(second)
    return features


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


def delivered(endpoint: str, features: Features, messages: int) -> float:
    """Return the seconds until the last of some messages is acknowledged."""
    receiver = SPAWN.Process(target=receive, args=(endpoint,), daemon=True)
    receiver.start()
    with Sender(FEATURES, Endpoint.parse(endpoint), WINDOW) as sender:
        while sender.ask_position(0) is None:  # no receiver yet
            receiver.join(0.01)
        begin = perf_counter()
        for seq in range(1, messages + 1):
            while sender.window.full:
                sender.poll(0.01)
            sender.send(replace(features, seq=seq))
        while sender.window.stored < messages:
            sender.poll(0.01)
        seconds = perf_counter() - begin
        sender.send(End(messages + 1, "that was all"))
    receiver.join()
    return seconds


def receive(endpoint: str) -> None:
    """Receive and acknowledge every message until the end."""
    with Receiver(FEATURES, Endpoint.parse(endpoint), Position(), WINDOW) as features:
        message = None
        while not isinstance(message, End):
            message = features.receive(0.1)
            features.answer()
            if message is not None:
                features.acknowledge(Position(message.seq, message.seq))


if __name__ == "__main__":
    benchmark(figures, command(__doc__), messages=(5_000, "number of messages over each transport"))
