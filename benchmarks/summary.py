"""Summaries of image collections: energy kept by `catstream.summarize`, and by other choices of k images.

The energy is the exact share ||A P||^2 / ||A||^2, with a row of A for each image, and P the projection on the span of
the chosen rows. The greedy choice and the best subspace of dimension k, which is an upper bound, have all rows at once.
"""

from __future__ import annotations

import argparse
import tracemalloc
from collections.abc import Iterable, Iterator
from statistics import fmean
from time import perf_counter

import numpy as np
from sequences import sequences
from table import Table, benchmark, command

from catstream.applications.evaluation.datasets import Sequence
from catstream.applications.summaries.images import describe
from catstream.applications.summaries.selection import RowSelection, choose

COLUMNS = (
    "collection",
    "images",
    "k",
    "catstream",
    "random",
    "evenly spaced",
    "k-means",
    "greedy, all rows",
    "best subspace",
)
_LONG = 900  # frames of a sequence that is a collection by itself
_STRIDE = 10  # of the frames of the mixed collection
_DRAWS = 10
_EQUAL = 1e-9  # share of the energy of images below which a direction is rounding, if two images are equal


def figures(options: argparse.Namespace) -> Iterator[Table]:
    found = sequences(options)
    sizes, long = ((2,), 1) if options.quick else (options.k, _LONG)
    rows = {sequence.name: described(sequence) for sequence in found}
    collections = {
        "all sequences": np.concatenate([each[:: 1 if options.quick else _STRIDE] for each in rows.values()])
    }
    collections |= {name: each for name, each in rows.items() if len(each) >= long}
    table = [(name, len(each), *row) for name, each in collections.items() for row in kept_by_each(each, sizes)]
    yield Table("Energy kept", COLUMNS, table, f"random: mean of {_DRAWS} draws")
    largest = max(rows.values(), key=len)
    repeats = (1, 2) if options.quick else (1, 4)
    costs = [cost(np.tile(largest, (times, 1)), sizes[0]) for times in repeats]
    yield Table("Cost of a selection", ("images", "us an image", "most MB"), costs, "rows of one sequence, repeated")


def described(sequence: Sequence) -> np.ndarray:
    return np.array([describe(image) for image in sequence.frames()])


def kept_by_each(rows: np.ndarray, sizes: Iterable[int]) -> Iterator[tuple[int, *tuple[float, ...]]]:
    """Yield each k, and the energy that each method keeps with k rows, in the order of the columns."""
    exact = rows.astype(np.float64)
    gram = exact @ exact.T
    strongest = np.linalg.eigvalsh(gram)[::-1]
    rng = np.random.default_rng(0)

    def kept(numbers: Iterable[int]) -> float:
        chosen = sorted(set(numbers))
        shares = np.linalg.pinv(gram[np.ix_(chosen, chosen)], rcond=_EQUAL, hermitian=True) @ gram[chosen]
        return float(np.sum(gram[chosen] * shares) / strongest.sum())

    for k in sizes:
        yield (
            k,
            kept(selected(rows, k)),
            fmean(kept(rng.choice(len(rows), k, replace=False)) for _ in range(_DRAWS)),
            kept(((np.arange(k) + 0.5) * len(rows) / k).astype(int)),
            kept(nearest_to_means(rows, k)),
            kept(choose(gram, gram, k)[0]),
            float(strongest[:k].sum() / strongest.sum()),
        )


def selected(rows: np.ndarray, k: int) -> list[int]:
    selection = RowSelection[int](k)
    for number, row in enumerate(rows):
        selection.add(row, number)
    return selection.result().selected


def nearest_to_means(rows: np.ndarray, k: int) -> list[int]:
    """Return the row nearest to each mean of k-means."""
    from sklearn.cluster import KMeans

    means = KMeans(k, n_init=3, random_state=0).fit(rows).cluster_centers_
    return [int(np.sum((rows - mean) ** 2, axis=1).argmin()) for mean in means]


def cost(rows: np.ndarray, k: int) -> tuple[int, float, float]:
    """Return the number of rows, microseconds for each, and the most megabytes that the selection allocates."""
    began = perf_counter()
    selected(rows, k)
    seconds = perf_counter() - began
    tracemalloc.start()
    selected(rows, k)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return len(rows), 1e6 * seconds / len(rows), most / 1e6


if __name__ == "__main__":
    parser = command(__doc__)
    parser.add_argument("-k", type=int, nargs="+", default=(5, 20, 50), help="numbers of images (default: %(default)s)")
    benchmark(figures, parser)
