"""Linear algebra on one thread, inside a program that has set something else."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import cv2
import pytest
import scipy.linalg  # noqa: F401  brings a BLAS of its own
from threadpoolctl import ThreadpoolController, threadpool_limits

from catstream.numerics.threads import _VARIABLES, _Libraries, one_thread


def counts():
    """Threads of each BLAS of this process."""
    return {library.filepath: library.get_num_threads() for library in ThreadpoolController().lib_controllers}


@pytest.fixture
def libraries(monkeypatch):
    """As in a user's program with two threads: nobody else in this process holds it at one."""
    own = _Libraries()
    monkeypatch.setattr("catstream.numerics.threads._libraries", own)
    with threadpool_limits(2):
        if set(counts().values()) != {2}:
            pytest.skip("this machine has one core, or BLAS without threads")
        yield own


FIRST_USE = """
from threadpoolctl import threadpool_info
from catstream.numerics.threads import one_thread
with one_thread():
    import numpy, scipy.linalg
    print({library["num_threads"] for library in threadpool_info()})
"""


def test_a_library_that_is_imported_inside_is_on_one_thread_too():
    environment = os.environ | dict.fromkeys(_VARIABLES, "2")
    said = subprocess.run(
        [sys.executable, "-c", FIRST_USE], env=environment, capture_output=True, text=True, check=True
    )
    assert said.stdout == "{1}\n"


@pytest.mark.usefixtures("libraries")
def test_all_libraries_are_on_one_thread_inside_and_as_before_outside():
    before = counts()
    with one_thread(), one_thread():
        assert set(counts().values()) == {1}
    assert counts() == before


@pytest.mark.usefixtures("libraries")
def test_an_exception_restores_the_number_of_threads():
    before = counts()
    with pytest.raises(ZeroDivisionError), one_thread():
        _ = 1 / 0
    assert counts() == before


@pytest.mark.usefixtures("libraries")
def test_the_last_of_two_threads_restores_the_number():
    before, both, first_left = counts(), Barrier(2), Barrier(2)

    def first():
        with one_thread():
            both.wait(60)
        first_left.wait(60)

    def last():
        with one_thread():
            both.wait(60)
            first_left.wait(60)
            return set(counts().values())

    with ThreadPoolExecutor(2) as pool:
        _, still = pool.submit(first), pool.submit(last)
        assert still.result() == {1}
    assert counts() == before


@pytest.mark.usefixtures("libraries")
def test_a_number_of_threads_set_by_the_user_meanwhile_is_kept():
    with one_thread():
        with threadpool_limits(1):
            pass
        libraries = [library for library in ThreadpoolController().lib_controllers if library.user_api == "blas"]
        for each in libraries:
            each._real_set_num_threads(3) if hasattr(each, "_real_set_num_threads") else each.set_num_threads(3)
        meant = [library.get_num_threads() for library in libraries]
    assert [library.get_num_threads() for library in libraries] == meant


def test_opencv_is_limited_only_if_requested():
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with one_thread():
            assert cv2.getNumThreads() == 2
        with one_thread(opencv=True):
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
