"""Measures whether the compressor slows down or its memory grows: a million features messages in one process,
and some through the compressor process.

The rows come from a detector on a real video; each message contains a random choice of a few rows, with a random
change of brightness. With few rows in each message, a million messages take only minutes; the expected memory depends
on the number of rows.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import NamedTuple

import numpy as np
import psutil
from learning import features as learned
from sequences import named, scratch
from table import Table, benchmark, command, plots

from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.compression.forest import Forest
from catstream.compression.tree import CoresetTree
from catstream.errors import ServiceError
from catstream.evaluation.datasets import Sequence
from catstream.messages.heads import APPEARANCE, GROUPS
from catstream.messages.kinds import End, Features, ObjectFeatures, TrainingRows
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import FEATURES
from catstream.wire.endpoint import Endpoint

BLOCKS = 200  # number of measurements
GAIN = 0.02  # standard deviation of a drawn row's brightness

COLUMNS = ("messages", "rows", "us a message", "nodes", "trees MB", "law MB", "resident MB", "handles", "disk MB")


class Measurement(NamedTuple):
    """The measurements after some messages; a megabyte is 10**6 bytes.

    messages, rows  number of messages processed, and of rows inserted into all trees
    micros          microseconds of processor time per message since the last measurement, with reductions and samples
    nodes, trees    nodes of all trees, and megabytes of their arrays
    law             megabytes of log2(p/n) + 1 nodes and n pending rows in each tree
    resident        megabytes of the process
    handles         open files and sockets
    disk            megabytes of the checkpoint
    """

    messages: int
    rows: int
    micros: float
    nodes: int
    trees: float
    law: float
    resident: float
    handles: int
    disk: float


class Stream:
    """Makes an endless sequence of features messages from the rows of a video."""

    def __init__(self, sequence: Sequence, frames: int, settings: Settings) -> None:
        features = learned(sequence, 0, frames, settings)
        seen = _all(features, APPEARANCE)
        self._object, self._background = seen.rows[seen.labels == 1], seen.rows[seen.labels == 0]
        self._others = {group: _all(features, group) for group in GROUPS if group != APPEARANCE}
        self._box, self._random = features[-1].box, np.random.default_rng(settings.run.seed)

    def message(self, seq: int) -> Features:
        """A row of the object, one of the background and two of each other group."""
        rows = np.stack([part[self._random.integers(len(part))] for part in (self._object, self._background)])
        training = {APPEARANCE: TrainingRows.labelled(rows * self._gains(), [1, 0])}
        for group, seen in self._others.items():
            pair = self._random.integers(len(seen), size=2)
            training[group] = TrainingRows.labelled(seen.rows[pair] * self._gains(), seen.labels[pair])
        return Features(seq, seq - 1, (seq - 1) / 25, {UNNAMED: ObjectFeatures(self._box, training)})

    def _gains(self) -> np.ndarray:
        """The changes of brightness of two rows, float32 (2, 1)."""
        return self._random.normal(1, GAIN, (2, 1)).astype(np.float32)


def _all(features: list[ObjectFeatures], group: str) -> TrainingRows:
    """The training rows of a group of all frames."""
    found = [each.training[group] for each in features if group in each.training]
    return sum(found[1:], start=found[0])


def figures(options: argparse.Namespace) -> Iterator[Table]:
    settings = Settings()
    messages, through, frames = (20, 20, 8) if options.quick else (options.messages, options.through, 200)
    stream = Stream(named(options, "TLD_01_david"), frames, settings)
    here, there = alone(stream, messages, settings), served(stream, through, settings)
    draw(here, options.plot)
    note = (
        f"time is the processor's; law: log2(p/n) + 1 nodes of n = {settings.coreset.size} rows a tree; {options.plot}"
    )
    yield Table("In one process", COLUMNS, list(doubling(here)), note)
    note = "the compressor's process, with its checkpoints, over a Unix socket: from the sender's side, all stored"
    yield Table("Through the process", ("messages", "us a message", "resident MB", "handles", "disk MB"), there, note)


def alone(stream: Stream, messages: int, settings: Settings) -> list[Measurement]:
    """Run a forest in this process; measure and save it after each block."""
    forest, me, file, measurements = Forest(settings), psutil.Process(), scratch() / "soak.safetensors", []
    block, busy = max(messages // BLOCKS, 1), 0.0
    for seq in range(1, messages + 1):
        message = stream.message(seq)
        begin = process_time()
        forest.take(message)
        busy += process_time() - begin
        if seq % block == 0:
            forest.save(file)
            seen = forest.counters()
            measurements.append(
                Measurement(
                    seq, int(seen["rows"]), busy / block * 1e6, int(seen["nodes"]), seen["bytes"] / 1e6,
                    sum(map(law, forest.compressors[UNNAMED].trees.values())) / 1e6,
                    me.memory_info().rss / 1e6, me.num_fds(), file.stat().st_size / 1e6,
                )
            )  # fmt: skip
            busy = 0.0
            if len(measurements) % 10 == 0:
                print(
                    f"{seq} of {messages} messages, {measurements[-1].micros:.0f} us each", file=sys.stderr, flush=True
                )
    return measurements


def law(tree: CoresetTree) -> float:
    """Return the maximum bytes of a tree of this number of rows."""
    nodes = math.log2(max(tree.rows_seen / tree.size, 1)) + 1
    return nodes * tree.width * (4 * tree.size + 8) + 4 * tree.size * tree.width


def served(stream: Stream, messages: int, settings: Settings) -> list[tuple[int, float, float, int, float]]:
    """Measure the compressor process: a row for each fifth of the messages."""
    rows = []
    with TemporaryDirectory(prefix="catstream-") as folder:
        command = [sys.executable, "-P", Path(__file__).parents[1] / "services" / "compressor.py"]
        options = ["--set", f"run.endpoint={folder}", "--state", f"{folder}/state"]
        with (
            subprocess.Popen([*command, *options], stderr=subprocess.DEVNULL) as process,
            Sender(FEATURES, Endpoint.parse(folder), settings.run.unstored_frames) as sender,
        ):
            seen, part, begin = psutil.Process(process.pid), messages // 5, 0.0
            for seq in range(1, messages + 1):
                while sender.window.full:
                    sender.poll(0.05)
                    if process.poll() is not None:
                        raise ServiceError(
                            f"the compressor ended with {process.returncode}: run it in a terminal to see why"
                        )
                sender.send(stream.message(seq))
                if seq == 1:  # the imports are finished once the process has answered
                    wait(sender, 1)
                    begin = perf_counter()
                if seq % part == 0:
                    wait(sender, seq)
                    micros = (perf_counter() - begin) / part * 1e6
                    disk = sum(file.stat().st_size for file in Path(folder, "state").iterdir()) / 1e6
                    rows.append((seq, micros, seen.memory_info().rss / 1e6, seen.num_fds(), disk))
                    begin = perf_counter()
            sender.send(End(messages + 1, "that was all"))
            wait(sender, messages + 1)
    return rows


def wait(sender: Sender, seq: int) -> None:
    """Wait until a message is stored."""
    while sender.window.stored < seq:
        sender.poll(0.05)


def doubling(measurements: list[Measurement]) -> Iterator[Measurement]:
    """The last measurements whose messages double from one to the next; time is the mean of up to four before each."""
    for place in (len(measurements) // 2**doubled - 1 for doubled in reversed(range(BLOCKS.bit_length()))):
        if place >= 0:
            near = [measurement.micros for measurement in measurements[max(place - 3, 0) : place + 1]]
            yield measurements[place]._replace(micros=sum(near) / len(near))


def draw(measurements: list[Measurement], file: Path) -> None:
    """Plot time per message, and memory with its bound, against the number of messages."""
    counts = [measurement.messages for measurement in measurements]
    with plots(file, (8, 6), rows=2) as (time, memory):
        time.plot(counts, [measurement.micros for measurement in measurements])
        time.set(ylabel="us a message", ylim=(0, None))
        for label in ("resident", "law", "trees", "disk"):
            memory.plot(counts, [getattr(measurement, label) for measurement in measurements], label=label)
        memory.set(ylabel="MB", xlabel="messages of features", xscale="log", ylim=(0, None))
        memory.legend(fontsize="small")


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        messages=(1_000_000, "number of messages in one process"),
        through=(50_000, "number of messages through the compressor process"),
        plot=(Path("out/soak.png"), "plot"),
    )
