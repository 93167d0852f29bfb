"""The time limits of a package: all in one table, in the order that they must keep."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import catstream
from catstream.fleet import timing as fleet
from catstream.services import compressor_process, detector_process, process, supervisor
from catstream.web import app, dashboard, feed, server
from catstream.wire import timing as wire

CATSTREAM = Path(catstream.__file__).parent
DOCS = CATSTREAM.parent / "docs"

WEB = (
    (
        app.UPDATE_SECONDS,
        server.SHUTDOWN_SECONDS,
        "the server closes a page before it is told of its end",
    ),
    (dashboard.POINT_SECONDS, dashboard.RATE_SECONDS, "a chart of frames per second leaves out frames"),
    (wire.CHECK_SECONDS, feed.SILENCE_SECONDS, "a pipeline that rejects the keys counts as silent"),
    (wire.DRAIN_SECONDS, feed.DRAIN_SECONDS, "the last messages are dropped before their subscriptions have ended"),
    (app.RETRY_SECONDS, feed.IDLE_SECONDS, "the feed of a stream is closed while its page connects again"),
)
ATTEMPTS = 2**supervisor.RESTARTS
DETECTOR_END = detector_process._FEATURES_END_SECONDS + detector_process._RESULTS_END_SECONDS
SERVICES = (
    (process.MESSAGE_SECONDS, process.RUNNING_SECONDS, "a process without messages counts as stuck"),
    (process.HEALTH_SECONDS, wire.REPORT_SECONDS, "a client that waits for a health report receives none"),
    (supervisor.STEP_SECONDS, process.RUNNING_SECONDS, "a process counts as stuck as its program was suspended once"),
    (supervisor.RESTART_SECONDS * ATTEMPTS, supervisor.RECENT_SECONDS, "a process that dies is restarted for ever"),
    (compressor_process._SENDER_SECONDS, supervisor.SHUTDOWN_SECONDS, "a compressor is killed while its end is sent"),
    (DETECTOR_END, supervisor.SHUTDOWN_SECONDS, "a detector is killed while its end is stored"),
)
ORDER = [*wire.ORDER, *SERVICES, *WEB, *fleet.ORDER]
#: The files whose time limits are in one table, and what a time limit looks like there.
LIMITS = {
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
    assert f"within {feed.SILENCE_SECONDS:g} s" in (DOCS / "how-to" / "view.md").read_text()
    pause = f"a pause of {fleet.FIRST_PAUSE_SECONDS:g} s to {fleet.LONGEST_PAUSE_SECONDS:g} s"
    assert pause in (DOCS / "how-to" / "fleet.md").read_text()


def test_a_host_that_disappears_is_noticed_after_the_time_that_the_docs_say():
    page = (DOCS / "architecture.md").read_text()
    seconds = wire.KEEPALIVE_SECONDS + wire.KEEPALIVE_PROBES * wire.KEEPALIVE_PROBE_SECONDS
    assert f"starts after {wire.KEEPALIVE_SECONDS:g} s without traffic" in page
    assert f"closed after {seconds:g}" in page
