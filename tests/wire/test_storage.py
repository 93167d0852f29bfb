"""Files of arrays: written whole, read as they were, and refused if they are damaged."""

import fcntl
import os
import re
import stat
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.files import is_locked, lock, write_atomically
from catstream.errors import ProtocolError
from catstream.wire import storage

ARRAYS = {"rows": np.arange(-30, 30, dtype=np.float32).reshape(10, 6), "sum": np.linspace(0, 1, 6)}
METADATA = {"kind": "trees", "nodes": [{"level": 3, "energy": "0x1.8p+3"}, {"level": 0, "energy": "0x0p+0"}]}
WHOLE = storage.encode(ARRAYS, METADATA)


def test_file_without_a_secret_has_the_permissions_of_the_umask(tmp_path):
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


def refusal(content: bytes) -> str:
    """The error with which a file is refused; empty if it is read as it was written."""
    try:
        arrays, metadata = storage.decode(content, "trees")
    except ProtocolError as error:
        return str(error)
    np.testing.assert_equal((arrays, metadata), (ARRAYS, METADATA))
    return ""


@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=4))
def test_damaged_or_incomplete_file_is_refused(damage):
    content = bytearray(WHOLE)
    for place, byte in damage:
        content[int(place * len(content))] = byte
    message = (
        r"trees is damaged or not a file of catstream \((.|\n)*\): use an older copy, or a file that catstream wrote"
    )
    assert re.fullmatch(f"({message})?", refusal(bytes(content)))
    assert re.fullmatch(message, refusal(WHOLE[: int(damage[0][0] * len(WHOLE))]))


@pytest.mark.parametrize("name", ARRAYS)
def test_flipped_bit_of_an_array_is_refused_by_the_checksum(name):
    at = WHOLE.index(ARRAYS[name].tobytes())
    content = WHOLE[:at] + bytes([WHOLE[at] ^ 1]) + WHOLE[at + 1 :]
    with pytest.raises(ProtocolError, match="its checksum does not match"):
        storage.decode(content, "trees")


def test_queries_of_a_lock_do_not_see_each_other(tmp_path):
    path = tmp_path / "note"
    path.touch()
    with path.open() as one, path.open() as other, path.open() as owner:
        assert not is_locked(one.fileno())
        assert not is_locked(other.fileno()), "the first one still holds its shared lock"
        for asking in (one, other):
            fcntl.flock(asking, fcntl.LOCK_UN)
        assert lock(owner.fileno())
        assert is_locked(one.fileno())


def test_readers_see_whole_files_of_two_writers(tmp_path):
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
