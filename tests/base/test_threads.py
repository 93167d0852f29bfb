"""Linear algebra on one thread gives the same bits for any settings and imports of the program."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import cv2
import pytest
import scipy.linalg  # noqa: F401  brings a BLAS of its own
from threadpoolctl import ThreadpoolController, threadpool_limits

from catstream.base import threads
from catstream.base.threads import ONE_THREAD, one_thread


def counts():
    """Threads of each BLAS of this process."""
    return {library.filepath: library.get_num_threads() for library in ThreadpoolController().lib_controllers}


@pytest.fixture
def two_threads(monkeypatch):
    """As in a user's program, which runs BLAS on two threads."""
    monkeypatch.setattr(threads, "_limit", threads._Limit())  # that of this process holds it at one
    with threadpool_limits(2):
        if set(counts().values()) != {2}:
            pytest.skip("this machine has one core, or BLAS without threads")
        yield


FIRST_USE = """
from threadpoolctl import threadpool_info
from catstream.base.threads import one_thread
with one_thread():
    import numpy, scipy.linalg
    print({library["num_threads"] for library in threadpool_info()})
"""


def test_library_that_is_imported_inside_has_one_thread():
    environment = os.environ | dict.fromkeys(ONE_THREAD, "2")
    program = [sys.executable, "-c", FIRST_USE]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "{1}\n"


@pytest.mark.usefixtures("two_threads")
def test_libraries_have_one_thread_only_inside():
    before = counts()
    with one_thread(), one_thread():
        assert set(counts().values()) == {1}
    assert counts() == before
    with pytest.raises(ZeroDivisionError), one_thread():
        _ = 1 / 0
    assert counts() == before


@pytest.mark.usefixtures("two_threads")
def test_last_of_two_threads_restores_the_number():
    before, both, first_left = counts(), Barrier(2), Barrier(2)

    def first():
        with one_thread():
            both.wait(500)
        first_left.wait(500)

    def last():
        with one_thread():
            both.wait(500)
            first_left.wait(500)
            return set(counts().values())

    with ThreadPoolExecutor(2) as pool:
        _, still = pool.submit(first), pool.submit(last)
        assert still.result() == {1}
    assert counts() == before


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


#: Prints a digest of two models that a Tracker learns, merged.
PROGRAM = """
import sys
from itertools import islice
from hashlib import blake2b

import catstream
from catstream.video.source import open_source

video, *boxes = sys.argv[1:]
models = []
with open_source(video) as source:
    for box in boxes:
        tracker = catstream.Tracker()
        for number, frame in enumerate(islice(source, 25)):
            tracker.update(frame.image) if number else tracker.init(frame.image, box)
        models.append(tracker.saved_model())
print(blake2b(catstream.merge(models).to_bytes()).hexdigest())
"""

FIRST, LAST = "", "import numpy, scipy.linalg, cv2, sklearn.linear_model\n"  # catstream is imported first, or last


def test_models_have_the_same_bits_on_any_number_of_cpus(demo_video):
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        pytest.skip("this machine has one core")
    path, boxes = demo_video(50)
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", imports + PROGRAM, path, *(",".join(map(str, boxes[i])) for i in (0, 25))],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=lambda some=some: os.sched_setaffinity(0, some),
        )
        for imports, some in ((FIRST, cores[:1]), (LAST, cores[:2]))
    ]
    lines = [process.communicate()[0] for process in started]
    assert [process.returncode for process in started] == [0] * 2
    assert len(set(lines)) == 1, lines
