"""Kernels: compiled once, and loaded from the cache from then on."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

import numpy as np

from catstream.features import kernels, layout
from catstream.features.kernels import COMPILING

START = "import catstream.features.cells as cells, numpy; print(cells.lab(numpy.zeros((1, 3), numpy.uint8)).tolist())"


def start(folder):
    """Use a kernel in a process with this folder as the only one for a cache: what it logs."""
    folders = dict.fromkeys(("NUMBA_CACHE_DIR", "HOME", "XDG_CACHE_HOME"), str(folder))
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", START],
        env=os.environ | folders | {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"},
        check=True,
        capture_output=True,
        text=True,
    )
    assert process.stdout == "[[0, 128, 128]]\n"
    return process.stderr.splitlines()


def test_a_first_start_reports_that_it_compiles_and_a_damaged_cache_hinders_no_start(tmp_path):
    assert [start(tmp_path) for _ in range(2)] == [[COMPILING], []]
    (file,) = tmp_path.rglob("kernels.convert_to_lab*.nbi")
    file.write_bytes(b"")
    assert start(tmp_path) == [COMPILING]


def test_kernels_are_compiled_in_memory_if_no_folder_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    assert start(tmp_path / "file" / "folder") == [COMPILING]


def test_the_numbers_that_the_kernels_repeat_are_those_of_the_layout():
    for name in ("CELL", "WINDOW", "CHANNELS", "SIDE"):
        assert getattr(kernels, name) == getattr(layout, name)


def test_a_forked_process_and_threads_can_call_kernels():
    white, found = np.full((8, 1000, 3), 255, np.uint8), np.empty((8, 1000, 3), np.uint8)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(kernels.convert_to_lab, white, found))
    assert (found == [255, 128, 128]).all()
    fork = get_context("fork")
    receiver, sender = fork.Pipe(duplex=False)

    def child():
        kernels.convert_to_lab(white[0] // 255, found[0])
        sender.send(found[0, 0].tolist())

    process = fork.Process(target=child)
    process.start()
    assert receiver.recv() == [1, 128, 128]
    process.join()
