"""The time limits of the web page: all in one table, in the order that they must keep."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from catstream.web import timing

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "view.md"


@pytest.mark.parametrize(("shorter", "longer", "otherwise"), timing.ORDER, ids=[row[2] for row in timing.ORDER])
def test_a_time_limit_is_shorter_than_those_that_build_on_it(shorter, longer, otherwise):
    assert 0 < shorter < longer, f"otherwise {otherwise}"


def test_every_time_limit_is_in_the_table():
    limits = re.compile(r"^\s*\w*(?:_SECONDS|_pause)(?:: \w+)? = [0-9.]", re.MULTILINE)
    files = Path(timing.__file__).parent.glob("*.py")
    assert [path.name for path in files if limits.search(path.read_text())] == ["timing.py"]


def test_the_docs_say_after_which_time_a_process_is_silent():
    assert f"within {timing.SILENCE_SECONDS:g} s" in PAGE.read_text()
