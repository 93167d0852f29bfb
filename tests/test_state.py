"""The state on disk: what a run was started with."""

from __future__ import annotations

import os
import stat

import pytest

from catstream import storage
from catstream.box import Box
from catstream.settings import Settings
from catstream.state import Origin

ORIGIN = Origin("rtsp://me:secret@10.0.0.7/one", Box(1, 2, 30, 40), slice(0, None, 1), Settings(), (320, 240), 1e9)


@pytest.fixture
def umask():
    """Sets the umask for one test."""
    before = os.umask(0)
    yield os.umask
    os.umask(before)


def test_what_a_run_was_started_with_is_for_its_owner_from_the_first_byte(tmp_path, umask, monkeypatch):
    umask(0)
    (tmp_path / ".origin.safetensors.part").write_text("what a power cut left of an older catstream")
    modes, fsync = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: (modes.append(os.fstat(handle).st_mode), fsync(handle)))
    ORIGIN.save(tmp_path)
    (file,) = tmp_path.iterdir()
    assert {stat.S_IMODE(mode) for mode in (modes[0], file.stat().st_mode)} == {0o600}
    assert Origin.load(tmp_path) == ORIGIN


def test_what_holds_no_secret_is_for_whom_the_umask_says(tmp_path, umask):
    umask(0o027)
    storage.write(tmp_path / "tree", {}, {})
    assert stat.S_IMODE((tmp_path / "tree").stat().st_mode) == 0o640
