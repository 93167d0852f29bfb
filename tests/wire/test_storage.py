"""Files of arrays: written whole, read as they were, and refused if they are damaged."""

import fcntl
import os
import re
import stat
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from catstream.base.files import is_locked, lock, write_atomically
from catstream.errors import ProtocolError
from catstream.wire import storage

ARRAYS = {"rows": np.arange(-30, 30, dtype=np.float32).reshape(10, 6), "sum": np.linspace(0, 1, 6)}
METADATA = {"kind": "trees", "nodes": [{"level": 3, "energy": "0x1.8p+3"}, {"level": 0, "energy": "0x0p+0"}]}
WHOLE = storage.encode(ARRAYS, METADATA)


def test_a_file_without_a_secret_has_the_permissions_of_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_atomically(tmp_path / "tree", WHOLE)
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "tree").stat().st_mode) == 0o640


def test_arrays_of_each_type_are_read_as_they_were_written(tmp_path, rng):
    numbers = rng.uniform(0, 200, size=(3, 5))
    arrays = {name: numbers.astype(name) for name in ("uint8", "float32", "bool", "int64", "float64", "int32")}
    arrays |= {"empty": np.empty((0, 4), np.float32), "columns": np.asfortranarray(numbers), "größe": numbers[0]}
    storage.write(tmp_path / "tree", arrays, {"size": 3})
    read, metadata = storage.read(tmp_path / "tree")
    assert read.keys() == arrays.keys()
    for name, array in arrays.items():
        assert (read[name].dtype, read[name].tolist()) == (array.dtype, array.tolist())
    assert metadata == {"size": 3}


def refused(content: bytes) -> bool:
    """Whether a file is refused with a message that says what to do; otherwise it is read as it was written."""
    try:
        arrays, metadata = storage.decode(content, "trees")
    except ProtocolError as error:
        found = str(error)
    else:
        assert {name: array.tobytes() for name, array in arrays.items()} == {
            name: array.tobytes() for name, array in ARRAYS.items()
        }
        assert metadata == METADATA
        return False
    end = "use an older copy, or a file that catstream wrote"
    assert re.fullmatch(rf"trees is not an undamaged file of catstream \(.*\): {end}", found, re.DOTALL)
    return True


@given(st.floats(0, 1, exclude_max=True))
@example(0.001)
def test_an_incomplete_file_is_refused(share):
    assert refused(WHOLE[: int(share * len(WHOLE))])


@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_damaged_file_is_refused_unless_all_that_is_in_it_is_intact(damage):
    content = bytearray(WHOLE)
    for place, byte in damage:
        content[int(place * len(content))] = byte
    refused(bytes(content))  # or read as it was written


@pytest.mark.parametrize("name", ARRAYS)
def test_a_flipped_bit_of_an_array_is_refused_by_the_checksum(name):
    at = WHOLE.index(ARRAYS[name].tobytes())
    content = WHOLE[:at] + bytes([WHOLE[at] ^ 1]) + WHOLE[at + 1 :]
    with pytest.raises(ProtocolError, match="its checksum does not match"):
        storage.decode(content, "trees")


def test_two_processes_that_ask_whether_a_file_is_locked_do_not_see_each_other(tmp_path):
    path = tmp_path / "note"
    path.touch()
    with path.open() as one, path.open() as other, path.open() as owner:
        assert not is_locked(one.fileno())
        assert not is_locked(other.fileno()), "the first one still holds its shared lock"
        for asking in (one, other):
            fcntl.flock(asking, fcntl.LOCK_UN)
        assert lock(owner.fileno())
        assert is_locked(one.fileno())


def test_two_writers_of_one_file_do_not_disturb_each_other(tmp_path):
    """Each reader sees what one of them wrote, whole."""
    contents = [bytes([value]) * 200_000 for value in (1, 2)]
    write_atomically(tmp_path / "file", contents[0])

    def write(content):
        for _ in range(60):
            write_atomically(tmp_path / "file", content)

    with ThreadPoolExecutor(2) as pool:
        writers = [pool.submit(write, content) for content in contents]
        while not all(writer.done() for writer in writers):
            assert (tmp_path / "file").read_bytes() in contents
    assert [writer.result() for writer in writers] == [None, None]
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
