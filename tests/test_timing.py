"""The time limits of a package: all in one table, in the order that they must keep."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import catstream
from catstream.cli import fleet_commands
from catstream.fleet import actor, controller, fleet, life, store
from catstream.services import timing as services
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
FLEET = (
    (store.STORE_SECONDS, fleet.ANSWER_SECONDS, "a store that cannot be reached seems to be a controller that hangs"),
    (
        services.SHUTDOWN_SECONDS + store.STORE_SECONDS,
        life.STOPPING_SECONDS,
        "a stream is killed while it stores its last state",
    ),
    (life.STOPPING_SECONDS, fleet.DOWN_SECONDS, "`down` ends before a stream that hangs was killed"),
    (controller.PLACED_SECONDS, fleet_commands.UP_SECONDS, "`up` ends before it says that Ray places no stream"),
    (controller.QUIET_SECONDS, life.SILENT_SECONDS, "a stream is started again before it is said that it is silent"),
)
ORDER = [*wire.ORDER, *services.ORDER, *WEB, *FLEET]
#: The files whose time limits are in one table, and what a time limit looks like there.
LIMITS = {
    "wire": (
        [*CATSTREAM.glob("wire/*.py"), *(CATSTREAM / "client" / f"{name}.py" for name in ("control", "subscription"))],
        r"^\s*\w*(?:_SECONDS|_MILLISECONDS|PATIENCE)(?:: \w+)? = [0-9.]|: float = [1-9]",
    ),
    "services": (
        [*Path(services.__file__).parent.glob("*.py")],
        r"^\s*\w*(?:_SECONDS|_PERIOD)(?:: \w+)? = [0-9.(]|(?:receive|wait|sleep)\([0-9]*[.1-9]",
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
    pause = f"a pause of {actor.FIRST_PAUSE_SECONDS:g} s to {actor.LONGEST_PAUSE_SECONDS:g} s"
    assert pause in (DOCS / "how-to" / "fleet.md").read_text()


def test_a_host_that_disappears_is_noticed_after_the_time_that_the_docs_say():
    page = (DOCS / "architecture.md").read_text()
    seconds = wire.KEEPALIVE_SECONDS + wire.KEEPALIVE_PROBES * wire.KEEPALIVE_PROBE_SECONDS
    assert f"starts after {wire.KEEPALIVE_SECONDS:g} s without traffic" in page
    assert f"closed after {seconds:g}" in page
