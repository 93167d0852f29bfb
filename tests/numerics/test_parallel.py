"""Calls in threads: the results are those of a loop."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from catstream.numerics import parallel
from catstream.numerics.parallel import Scratch, in_parallel


@pytest.fixture(params=[1, 3], ids="{} cores".format)
def cores(request, monkeypatch):
    monkeypatch.setattr(parallel, "_cores", lambda: request.param)
    parallel._pool.cache_clear()
    yield request.param
    parallel._pool.cache_clear()


@pytest.mark.usefixtures("cores")
def test_results_have_the_order_of_the_items():
    assert in_parallel(lambda item: item**2, range(50)) == [item**2 for item in range(50)]
    assert in_parallel(str, []) == []


def test_items_are_processed_at_the_same_time_if_there_are_cores(cores):
    barrier = threading.Barrier(min(cores, 2))
    if cores > 1:
        assert len(set(in_parallel(lambda _: barrier.wait(60), range(2)))) == 2


def test_the_first_error_is_raised(cores):
    ended = []

    def call(item):
        if item in (1, 2):
            raise ValueError(item)
        ended.append(item)

    with pytest.raises(ValueError, match="1"):
        in_parallel(call, range(4))
    assert set(ended) == ({0, 3} if cores > 1 else {0})


def test_scratch_is_kept_for_a_size_and_no_two_threads_share_it():
    scratch = Scratch(lambda size: (np.empty(size),))
    (here,) = scratch.kept(3)
    assert scratch.kept(3)[0] is here
    assert scratch.kept(4)[0] is not here
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: scratch.kept(3)).result()[0] is not here
