"""Kernels: compiled once, and loaded without the compiler from then on."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

import llvmlite
import llvmlite.binding as llvm
import numpy as np
import pytest

from catstream.features import COMPILING, compiled, compiler
from catstream.features.compiled import kernel

FACTOR = 3  # of the kernel `scaled`
SIGNATURE = "void(float64[::1], float64)"

#: Defines a kernel, calls it, and prints whether numba was imported.
SCRIPT = """
import sys
import numpy as np
from catstream.features.compiled import kernel

@kernel("void(int64[::1])")
def double(row):
    for i in range(len(row)):
        row[i] *= 2

row = np.arange(3)
double(row)
assert row.tolist() == [0, 2, 4]
print("numba" in sys.modules)
"""


def scale(row, factor):
    for i in range(len(row)):
        row[i] *= factor


def scale_first(row, factor):
    row[0] = factor + 1


def scaled(row, factor):
    scale(row, factor * FACTOR)


def start(folder, script=SCRIPT):
    """Run a script in a process of its own with this cache folder: whether it imported numba, and what it reports."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    process = subprocess.run(
        [sys.executable, "-c", script], env=environment, check=True, capture_output=True, text=True
    )
    return process.stdout.strip() == "True", process.stderr.splitlines()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setattr(compiled, "_FOLDER", tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def native(tmp_path_factory):
    """The kernel `scaled`."""
    with pytest.MonkeyPatch.context() as change:
        change.setattr(compiled, "_FOLDER", tmp_path_factory.mktemp("kernels"))
        return kernel(SIGNATURE)(scaled)


@pytest.fixture
def compiles(monkeypatch):
    """Names of the kernels that are compiled."""
    names, machine_code = [], compiler.machine_code
    monkeypatch.setattr(compiler, "machine_code", lambda name, *rest: names.append(name) or machine_code(name, *rest))
    return names


def test_the_detector_needs_no_compiler_from_its_second_start_on():
    script = "import sys, catstream.detection.detector; print({'numba', 'scipy'} & sys.modules.keys())"
    for _ in range(2):
        second = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    assert (second.stdout, second.stderr) == ("set()\n", "")


def test_a_first_start_reports_that_it_compiles_and_a_second_imports_no_compiler(tmp_path):
    assert [start(tmp_path) for _ in range(2)] == [(True, [COMPILING]), (False, [])]


def test_a_kernel_can_be_loaded_in_a_program_that_uses_numba(tmp_path):
    own = "import numba; numba.njit('void(int64[::1])')(lambda row: None)"
    for _ in range(2):
        start(tmp_path, f"{own}\n{SCRIPT}")
        start(tmp_path, f"{SCRIPT}\n{own}\ndouble(row)\nassert row.tolist() == [0, 4, 8]")


DAMAGES = {
    "empty": lambda _: b"",
    "truncated": lambda data: data[:-1],
    "changed": lambda data: data[:100] + bytes([data[100] ^ 1]) + data[101:],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_file_is_replaced(damage, folder, compiles):
    kernel(SIGNATURE)(scaled)
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    for _ in range(2):
        kernel(SIGNATURE)(scaled)
    assert len(compiles) == 2
    assert list(folder.iterdir()) == [file]


def test_kernels_are_compiled_in_memory_if_no_folder_can_be_written(tmp_path, compiles, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(compiled, "_FOLDER", tmp_path / "file" / "folder")
    row = np.ones(1)
    for _ in range(2):
        kernel(SIGNATURE)(scaled)(row, 1.0)
    assert (row[0], len(compiles)) == (9.0, 2)


def test_processes_that_compile_at_the_same_time_leave_one_whole_file(tmp_path):
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(start, [tmp_path] * 3))
    assert len(list(tmp_path.iterdir())) == 1
    assert start(tmp_path) == (False, [])


@pytest.mark.usefixtures("folder")
def test_a_kernel_is_compiled_again_if_what_it_depends_on_changes(compiles, monkeypatch):
    signature = SIGNATURE

    def result():
        row = np.ones(1)
        kernel(signature)(scaled)(row, 2.0)
        return row[0], len(compiles)

    assert [result(), result()] == [(6.0, 1), (6.0, 1)]
    monkeypatch.setitem(globals(), "FACTOR", 4)
    assert [result(), result()] == [(8.0, 2), (8.0, 2)]
    monkeypatch.setitem(globals(), "scale", scale_first)
    assert [result(), result()] == [(9.0, 3), (9.0, 3)]
    signature = "void(float64[:], float64)"
    assert [result(), result()] == [(9.0, 4), (9.0, 4)]


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        (compiled, "version", lambda library: f"{library} of tomorrow"),
        (llvmlite, "__version__", "0.0"),
        (llvm, "get_host_cpu_name", lambda: "another"),
        (compiled, "EXTENSION_SUFFIXES", [".cpython-0.so"]),
    ],
)
def test_the_file_of_another_compiler_or_processor_is_not_used(owner, name, value, monkeypatch):
    def digest():
        compiled._compiler.cache_clear()
        return compiled._digest("name", scaled, SIGNATURE)

    before = digest()
    assert digest() == before
    with monkeypatch.context() as change:
        change.setattr(owner, name, value)
        assert digest() != before
    assert digest() == before


@pytest.mark.parametrize(
    "arguments",
    [
        [np.zeros(2)],
        [np.zeros(2), 1.0, 1.0],
        [[0.0, 0.0], 1.0],
        [None, 1.0],
        [np.zeros(2, np.float32), 1.0],
        [np.zeros(2, ">f8"), 1.0],
        [np.zeros((2, 1)), 1.0],
        [np.zeros(4)[::2], 1.0],
        [np.frombuffer(bytes(16)), 1.0],
        [np.frombuffer(bytearray(17), offset=1), 1.0],
        [np.zeros(2), "1"],
    ],
)
def test_an_argument_of_another_type_is_refused(arguments, native):
    with pytest.raises(TypeError):
        native(*arguments)


def fill(row):
    row[:] = np.zeros(len(row))


def fail(row):
    if row[0]:
        raise ValueError


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("function", [fill, fail])
def test_a_kernel_that_allocates_or_raises_is_refused(function):
    with pytest.raises(TypeError, match="may allocate or raise"):
        kernel("void(float64[::1])")(function)


@pytest.mark.usefixtures("folder")
def test_a_kernel_gets_arrays_and_numbers_as_they_are():
    @kernel("void(float64[:,:], uint8[:,:,::1], int64, float32, float64, float64[::1])")
    def describe(strided, contiguous, integer, single, double, found):
        found[0], found[1] = strided.shape[0], strided.shape[1]
        found[2], found[3] = strided[1, 2], contiguous[1, 2, 3]
        found[4], found[5], found[6] = integer, single, double

    strided = np.arange(48.0).reshape(6, 8)[::2, ::-1]
    contiguous = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    found = np.empty(7)
    describe(strided, contiguous, -(2**40), 0.1, 0.1, found)
    assert found.tolist() == [3, 8, strided[1, 2], 23, -(2**40), float(np.float32(0.1)), 0.1]


def test_a_forked_process_and_threads_can_call_kernels(native):
    rows = np.ones((8, 1000))
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda row: native(row, 2.0), rows))
    assert (rows == 6).all()
    fork = get_context("fork")
    receiver, sender = fork.Pipe(duplex=False)

    def child():
        native(rows[0], 2.0)
        sender.send(rows[0].tolist())

    process = fork.Process(target=child)
    process.start()
    assert receiver.recv() == [36.0] * 1000
    process.join()


def test_kernels_are_cached_in_another_folder_if_the_package_is_read_only(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, _: str(path).startswith(str(tmp_path)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compiled._cache_folder() == tmp_path / "catstream"


def test_a_folder_of_another_user_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, _: str(path).startswith(str(tmp_path)))
    monkeypatch.setattr(os, "getuid", lambda: (tmp_path.stat().st_uid) + 1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert not str(compiled._cache_folder()).startswith(str(tmp_path))
