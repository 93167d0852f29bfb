"""Coverage-guided fuzzing: a million inputs for each decoder, with limits on the time and memory of each input.

Each decoder has a process of its own under atheris (libFuzzer), which starts from valid messages or files and changes
them if the change reaches new code. A decoder must accept an input, or reject it with its specified exception. Any
other exception, an input that takes longer than 5 seconds, and a growth of 64 MB since the first thousandth of the
inputs end the process and this program, which prints the name of the file with the input.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import atheris
import numpy as np
from table import Table, benchmark, command

KERNELS = ["features.kernels", "features.sampling", "detection.sparse_coding"]  # compiled by numba: no bytecode

with atheris.instrument_imports(include=["catstream"], exclude=[f"catstream.{name}" for name in KERNELS]):
    from catstream.base.box import Box
    from catstream.base.settings import Settings
    from catstream.client.saved_model import SavedModel
    from catstream.coreset.forest import Forest
    from catstream.errors import CatstreamError, ProtocolError, ServiceError, SettingsError
    from catstream.wire import storage
    from catstream.wire.codec import KINDS, decode, encode, topic_of
    from catstream.wire.heads import GROUPS
    from catstream.wire.keys import Keys, create
    from catstream.wire.messages import DetectorState, Features, ObjectFeatures, TrainingRows

    sys.path.append(str(Path(__file__).parents[1]))
    from tests.wire.examples import example

SECONDS = 5  # time limit of an input
MEGABYTES = 64  # limit of the growth of resident memory
LONGEST = 4096  # maximum length of an input, unless a seed is longer
SETTINGS = Settings(coreset={"size": 2})
WIDTH = 6  # columns of the rows in files; those of a real video would make the inputs long
BOX = Box(1.0, 2.0, 9.0, 9.0)

COLUMNS = ("decoder", "inputs", "accepted", "rejected", "inputs per second", "MB more", "crashes", "hangs")


class Decoder:
    """A decoder of untrusted bytes.

    take   decodes an input
    error  exception by which it rejects an input
    seeds  valid inputs
    """

    def __init__(self, take: Callable[[bytes], Any], error: type[CatstreamError], *seeds: bytes) -> None:
        self.take, self.error, self.seeds = take, error, seeds


def decoders(folder: Path) -> dict[str, Decoder]:
    """Return all decoders of untrusted bytes: each kind of message, and each kind of file.

    Parameters
    ----------
    folder : for the files
    """
    seeds = {name: [example(kind, full) for full in (True, False)] for name, kind in KINDS.items()}
    found = {
        name: Decoder(lambda data, kind=kind: encode(decode(data, kind)), ProtocolError, *map(encode, seeds[name]))
        for name, kind in KINDS.items()
    }
    forest = grown()
    forest.save(folder / "checkpoint")
    SavedModel.of(forest.compressors["anna"], SETTINGS).save(folder / "learned")
    create(folder / "keys")
    found |= {
        "any message": Decoder(
            lambda data: encode(decode(data, *KINDS.values())),
            ProtocolError,
            *(encode(each) for several in seeds.values() for each in several),
        ),
        "topic": Decoder(topic_of, ProtocolError, *(encode(both[0]) for both in seeds.values())),
        "storage": filed(folder / "a", storage.read, ProtocolError, (folder / "checkpoint").read_bytes()),
        "checkpoint": filed(
            folder / "b",
            forged(lambda path: Forest.load(path, SETTINGS).counters()),
            CatstreamError,
            (folder / "checkpoint").read_bytes(),
        ),
        "saved model": filed(folder / "e", forged(narrow), CatstreamError, (folder / "learned").read_bytes()),
        "settings": filed(
            folder / "d.toml",
            lambda path: Settings.load(file=path, environment={}),
            SettingsError,
            b"[coreset]\nsize = 128\n[training]\nclassifier = 'joint'\n",
        ),
        "keys": filed(
            folder / "keys" / "client.key",
            lambda _: Keys.load(folder / "keys"),
            ServiceError,
            (folder / "keys" / "client.key").read_bytes(),
        ),
    }
    return found


def grown() -> Forest:
    """Return the trees of two objects."""
    forest = Forest(SETTINGS)
    for seq in range(1, 12):
        rows = np.random.default_rng(seq).normal(size=(4, WIDTH)).astype("f4")
        training = dict.fromkeys(GROUPS, TrainingRows.labelled(rows, [1, 0, 1, 0]))
        part = ObjectFeatures(BOX, training, example(DetectorState))
        forest.take(Features(seq - 1, 0.0, {"anna": part, "ben": part}))
    return forest


def narrow(path: Path) -> SavedModel:
    """Return a saved model whose rows have `WIDTH` columns."""
    with patch("catstream.client.saved_model.ROW_LENGTH", WIDTH):
        return SavedModel.load(path)


def forged(read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """Return a reader that ignores checksums, because an attacker writes correct ones."""

    def reading(path: Path) -> None:
        with patch.object(storage, "_checksum", lambda *_: Anything()):
            read(path)

    return reading


class Anything:
    """Compares equal to everything."""

    def __ne__(self, _: object) -> bool:
        return False


def filed(path: Path, read: Callable[[Path], Any], error: type[CatstreamError], seed: bytes) -> Decoder:
    """Return a decoder for the content of a file."""
    path.touch(mode=0o600)

    def take(data: bytes) -> None:
        path.write_bytes(data)
        read(path)

    return Decoder(take, error, seed)


class Trial:
    """Runs one decoder in a process of its own, and counts accepted and rejected inputs.

    totals : file that holds the count, written now and then
    """

    def __init__(self, decoder: Decoder, inputs: int, totals: Path) -> None:
        self._decoder, self._inputs, self._totals = decoder, inputs, totals
        self._accepted = self._rejected = 0
        self._before = self._most = 0.0

    def __call__(self, data: bytes) -> None:
        try:
            self._decoder.take(data)
            self._accepted += 1
        except self._decoder.error:
            self._rejected += 1
        count = self._accepted + self._rejected
        if count % max(1, self._inputs // 1000) == 0:
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
            self._before = self._before or resident
            self._most = max(self._most, resident - self._before)
            self._totals.write_text(json.dumps([count, self._accepted, self._rejected, self._most]))
            if self._most > MEGABYTES:
                raise MemoryError(f"{self._most:.0f} MB more than after the first inputs")


def trial(name: str, inputs: int, folder: Path) -> None:
    """Run the process of one decoder; does not return."""
    decoder = decoders(folder)[name]
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, seed in enumerate(decoder.seeds):
        (corpus / str(number)).write_bytes(seed)
    limits = [
        f"-runs={inputs}",
        f"-timeout={SECONDS}",
        f"-max_len={max(LONGEST, *map(len, decoder.seeds))}",
        "-rss_limit_mb=0",
        "-seed=1",
    ]
    quiet = ["-print_final_stats=0", "-verbosity=0", f"-artifact_prefix={Path.cwd()}/{name.replace(' ', '-')}-"]
    atheris.Setup([sys.argv[0], *limits, *quiet, str(corpus)], Trial(decoder, inputs, folder / "totals"))
    atheris.Fuzz()


def figures(options: argparse.Namespace) -> Iterator[Table]:
    if options.trial:
        trial(options.trial, options.inputs, options.folder)
    inputs = 1000 if options.quick else options.inputs
    rows = []
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as home:
        (Path(home) / "names").mkdir()
        names = [name for name in decoders(Path(home) / "names") if not options.only or name in options.only]
        for number, name in enumerate(names[:: 5 if options.quick else 1]):
            folder = Path(home) / str(number)
            folder.mkdir()
            command = [sys.executable, __file__, "--trial", name, "--inputs", str(inputs), "--folder", str(folder)]
            before = os.times().children_user
            done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
            seconds = os.times().children_user - before
            if done.returncode:
                raise SystemExit(f"{name}: {done.stderr[-4000:]}")
            count, accepted, rejected, megabytes = json.loads((folder / "totals").read_text())
            rows.append((name, count, accepted, rejected, round(count / max(seconds, 0.01)), round(megabytes, 1), 0, 0))
            print(f"{name}: {count} inputs, {seconds:.0f} s", file=sys.stderr)
    note = (
        f"an input is at most {LONGEST} bytes, or as long as the longest valid one; "
        f"a crash, an input of {SECONDS} s, or {MEGABYTES} MB more ends the run"
    )
    yield Table("Hostile inputs", COLUMNS, rows, note)


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("--only", nargs="*", metavar="NAME", help="only these decoders")
    parser.add_argument("--trial", metavar="NAME", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    benchmark(figures, parser, inputs=(1_000_000, "number of inputs for each decoder"))
