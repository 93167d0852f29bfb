"""Settings from a file: what is none is refused, naming the file."""

from __future__ import annotations

import pytest

from catstream.errors import SettingsError
from catstream.settings import Settings


@pytest.mark.parametrize("text", [b"\xff", b"coreset_size", b"x = " + b"[" * 100_000], ids=["bytes", "text", "nested"])
def test_a_file_that_is_not_toml_is_named(text, tmp_path):
    (tmp_path / "set.toml").write_bytes(text)
    with pytest.raises(SettingsError, match=r"set\.toml is not TOML"):
        Settings.load(file=tmp_path / "set.toml", environment={})
