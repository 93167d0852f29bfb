"""The time limits of a fleet: all in one table, in the order that they must keep."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from catstream.cli import fleet
from catstream.fleet import timing

FILES = [*Path(timing.__file__).parent.glob("*.py"), Path(fleet.__file__)]


@pytest.mark.parametrize(("shorter", "longer", "otherwise"), timing.ORDER, ids=[row[2] for row in timing.ORDER])
def test_a_time_limit_is_shorter_than_those_that_build_on_it(shorter, longer, otherwise):
    assert 0 < shorter < longer, f"otherwise {otherwise}"


def test_every_time_limit_is_in_the_table():
    limits = re.compile(
        r"^_?\w*(?:_SECONDS|_PAUSE)\b[^=\n]* = [0-9.({]|(?:wait|sleep|timeout=)\(?[0-9]*[.1-9]|_ms\": \"[0-9]",
        re.MULTILINE,
    )
    assert [path.name for path in FILES if limits.search(path.read_text())] == ["timing.py"]


def test_a_pause_and_the_notice_of_a_death_are_as_long_as_the_docs_say():
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "fleet.md").read_text()
    assert f"a pause of {timing.FIRST_PAUSE_SECONDS:g} s to {timing.LONGEST_PAUSE_SECONDS:g} s" in page
