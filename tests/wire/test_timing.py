"""The time limits of the sockets and of their clients: all in one table, in the order that they must keep."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from catstream.client import control, registry, subscription
from catstream.wire import socket, timing

FILES = [
    *Path(socket.__file__).parent.glob("*.py"),
    *(Path(each.__file__) for each in (control, registry, subscription)),
]


@pytest.mark.parametrize(("shorter", "longer", "otherwise"), timing.ORDER, ids=[row[2] for row in timing.ORDER])
def test_a_time_limit_is_shorter_than_those_that_build_on_it(shorter, longer, otherwise):
    assert 0 < shorter < longer, f"otherwise {otherwise}"


def test_every_time_limit_is_in_the_table():
    limits = re.compile(r"^\s*\w*(?:_SECONDS|_MILLISECONDS|PATIENCE)(?:: \w+)? = [0-9.]|: float = [1-9]", re.MULTILINE)
    assert [path.name for path in FILES if limits.search(path.read_text())] == ["timing.py"]


def test_a_host_that_disappears_is_noticed_after_the_time_that_the_docs_say():
    page = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text()
    seconds = timing.KEEPALIVE_SECONDS + timing.KEEPALIVE_PROBES * timing.KEEPALIVE_PROBE_SECONDS
    assert f"starts after {timing.KEEPALIVE_SECONDS:g} s without traffic" in page
    assert f"closed after {seconds:g}" in page
