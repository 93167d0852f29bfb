"""PCA of a stream: CoresetPCA beside scikit-learn's IncrementalPCA, fast frequent directions, and a PCA of all rows.

The rows are a signal of 64 directions with variances that fall as 1 / i^2, noise, and a mean far from zero. The signal
has other directions in each quarter of the stream. 16 components are compared, and all get 1,000 rows at a time; PCA
has to collect all of them first. n is the number of rows or components that are kept: IncrementalPCA forgets less if it
keeps more components than are asked for. Each is measured in a process of its own, in turns.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from time import perf_counter, process_time
from typing import Any

import numpy as np
from sklearn.decomposition import PCA, IncrementalPCA
from table import Table, benchmark, command

from catstream.base.threads import one_thread
from catstream.sketch import CoresetPCA

MEAN, COMPONENTS, PART = 40.0, 16, 1_000
STREAMS = ((64, 200_000), (512, 20_000), (4_096, 6_000))
METHODS = (
    "PCA of all rows",
    "IncrementalPCA, n = 16",
    "IncrementalPCA, n = 64",
    "frequent directions, n = 128",
    "CoresetPCA, n = 64",
    "CoresetPCA, n = 256",
)


class Collected:
    """A PCA that collects all rows first."""

    def __init__(self) -> None:
        self.parts: list[np.ndarray] = []

    def partial_fit(self, rows: np.ndarray) -> None:
        self.parts.append(rows)

    @property
    def components_(self) -> np.ndarray:
        return PCA(COMPONENTS).fit(np.vstack(self.parts)).components_


class FrequentDirections:
    """Fast frequent directions (Ghashami et al. 2016), in float64, of rows whose mean is known."""

    def __init__(self, size: int) -> None:
        self.size, self.filled, self.rows = size, 0, np.empty((0, 0))

    def partial_fit(self, rows: np.ndarray) -> None:
        if not len(self.rows):
            self.rows = np.zeros((2 * self.size, rows.shape[1]))
        for row in rows - MEAN:
            if self.filled == len(self.rows):
                _, values, vectors = np.linalg.svd(self.rows, full_matrices=False)
                shrunk = np.sqrt((values[: self.size] ** 2 - (values**2)[self.size : self.size + 1].sum()).clip(min=0))
                self.filled, self.rows[len(shrunk) :] = self.size, 0
                self.rows[: len(shrunk)] = shrunk[:, None] * vectors[: self.size]
            self.rows[self.filled] = row
            self.filled += 1

    @property
    def components_(self) -> np.ndarray:
        return np.linalg.svd(self.rows[: self.filled], full_matrices=False)[2][:COMPONENTS]


def estimator(method: str) -> Any:
    name, _, size = method.partition(", n = ")
    return {
        "PCA of all rows": Collected,
        "IncrementalPCA": lambda: IncrementalPCA(int(size)),
        "frequent directions": lambda: FrequentDirections(int(size)),
        "CoresetPCA": lambda: CoresetPCA(COMPONENTS, int(size)),
    }[name]()


def stream(features: int, count: int) -> Iterator[np.ndarray]:
    """Yield the rows, float64 (1000, d), always the same."""
    rng = np.random.default_rng(0)
    for begin in range(0, count, PART):
        if begin * 4 % count < 4 * PART:
            signal = rng.normal(size=(64, features)) / np.arange(1, 65)[:, None]
        with one_thread():  # otherwise threads that have computed the rows would still spin while they are inserted
            rows = rng.normal(size=(PART, 64)) @ signal
        yield rows + 0.1 * rng.normal(size=(PART, features)) + MEAN


def measured(method: str, features: int, count: int) -> dict[str, float]:
    """Return seconds, CPU seconds and additional MB of a fit, and the squared reconstruction error of all rows."""
    pca, wall, cpu, before = estimator(method), 0.0, 0.0, _megabytes()
    for rows in stream(features, count):
        begin, begin_cpu = perf_counter(), process_time()
        pca.partial_fit(rows)
        wall, cpu = wall + perf_counter() - begin, cpu + process_time() - begin_cpu
    begin, begin_cpu = perf_counter(), process_time()
    components = pca.components_[:COMPONENTS]
    wall, cpu = wall + perf_counter() - begin, cpu + process_time() - begin_cpu
    memory = _megabytes() - before
    offsets = (rows - MEAN for rows in stream(features, count))
    error = sum(np.sum(rows**2) - np.sum((rows @ components.T) ** 2) for rows in offsets)
    return {"wall": wall, "cpu": cpu, "memory": memory, "error": float(error)}


def _megabytes() -> float:
    """Peak of the resident memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def alone(method: str, features: int, count: int, *, limit: bool) -> dict[str, float]:
    """Measure in a process of its own, which limits BLAS to one thread by variables, or sets none."""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment |= dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1") if limit else {}
    words = [sys.executable, __file__, "--one", method, str(features), str(count)]
    done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def figures(options: argparse.Namespace) -> Iterator[Table]:
    rounds, streams = (1, ((64, 2_000),)) if options.quick else (options.rounds, STREAMS)
    methods = (METHODS[0], METHODS[-1]) if options.quick else METHODS
    rows = []
    for features, count in streams:
        runs = [{method: alone(method, features, count, limit=True) for method in methods} for _ in range(rounds)]
        least = runs[0][METHODS[0]]["error"]
        for method in methods:
            cpu = min(run[method]["cpu"] for run in runs)
            memory = max(run[method]["memory"] for run in runs)
            rows.append((method, features, count, f"{runs[0][method]['error'] / least - 1:.1e}", cpu, memory))
    columns = ("", "d", "rows", "excess error", "CPU s", "MB")
    note = "Excess: squared reconstruction error, divided by that of the PCA of all rows, less 1. BLAS has one thread."
    yield Table("PCA of a stream", columns, rows, note)

    features, count = streams[0][0], streams[0][1] // 2
    rows = []
    for method in methods[-1:] if options.quick else (METHODS[1], *METHODS[4:]):
        pairs = [[alone(method, features, count, limit=limit) for limit in (True, False)] for _ in range(rounds)]
        cpus, walls = ([min(pair[k][kind] for pair in pairs) for k in (0, 1)] for kind in ("cpu", "wall"))
        rows.append((method, *cpus, cpus[1] / cpus[0], walls[1] / walls[0]))
    columns = ("", "limited, CPU s", "default, CPU s", "ratio of CPU s", "ratio of seconds")
    note = f"{count} rows, d = {features}. Limited: OPENBLAS_NUM_THREADS=1. Default: no variable is set."
    yield Table("BLAS threads", columns, rows, note)


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("--rounds", type=int, default=1, help="rounds, of which the fastest counts (default: 1)")
    parser.add_argument("--one", nargs=3, metavar=("METHOD", "D", "ROWS"), help="measure one method, in this process")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measured(options.one[0], int(options.one[1]), int(options.one[2]))))
    else:
        benchmark(figures, parser)
