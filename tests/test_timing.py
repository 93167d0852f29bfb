"""The time limits of a package: all in one table, in the order that they must keep."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import catstream
from catstream.fleet import timing as fleet
from catstream.web import timing as web

CATSTREAM = Path(catstream.__file__).parent
HOW_TO = CATSTREAM.parent / "docs" / "how-to"

ORDER = [*web.ORDER, *fleet.ORDER]
#: The files whose time limits are in one table, and what a time limit looks like there.
LIMITS = {
    "web": ([*CATSTREAM.glob("web/*.py")], r"^\s*\w*(?:_SECONDS|_pause)(?:: \w+)? = [0-9.]"),
    "fleet": (
        [*CATSTREAM.glob("fleet/*.py"), CATSTREAM / "cli" / "fleet.py"],
        r"^_?\w*(?:_SECONDS|_PAUSE)\b[^=\n]* = [0-9.({]|(?:wait|sleep|timeout=)\(?[0-9]*[.1-9]|_ms\": \"[0-9]",
    ),
}


@pytest.mark.parametrize(("shorter", "longer", "otherwise"), ORDER, ids=[row[2] for row in ORDER])
def test_a_time_limit_is_shorter_than_those_that_build_on_it(shorter, longer, otherwise):
    assert 0 < shorter < longer, f"otherwise {otherwise}"


@pytest.mark.parametrize(("files", "limit"), LIMITS.values(), ids=LIMITS)
def test_every_time_limit_is_in_the_table(files, limit):
    assert [path.name for path in files if re.search(limit, path.read_text(), re.MULTILINE)] == ["timing.py"]


def test_the_docs_say_after_which_time_a_process_is_silent_and_a_stream_is_started_again():
    assert f"within {web.SILENCE_SECONDS:g} s" in (HOW_TO / "view.md").read_text()
    pause = f"a pause of {fleet.FIRST_PAUSE_SECONDS:g} s to {fleet.LONGEST_PAUSE_SECONDS:g} s"
    assert pause in (HOW_TO / "fleet.md").read_text()
