"""The orders between time limits that once broke something when they were not kept."""

from pathlib import Path

import pytest

import catstream
from catstream.cli import fleet_commands
from catstream.client import control, subscription
from catstream.fleet import actor, controller, fleet, life, store
from catstream.processes import compressor_process, detector_process, process, supervisor
from catstream.web import app, dashboard, feed, server
from catstream.wire import commands, go_back_n, newest, socket

DOCS = Path(catstream.__file__).parents[1] / "docs"

#: A limit, a longer one, and what goes wrong otherwise.
ORDER = [
    (process.MESSAGE_SECONDS, process.RUNNING_SECONDS, "a process without messages counts as stuck"),
    (supervisor.STEP_SECONDS, process.RUNNING_SECONDS, "a process counts as stuck as its program was suspended once"),
    (supervisor.RESTART_SECONDS * 2**5, supervisor.RECENT_SECONDS, "a process that dies is restarted for ever"),
    (compressor_process._SENDER_SECONDS, supervisor.SHUTDOWN_SECONDS, "a compressor is killed while its end is sent"),
    (detector_process._FEATURES_END_SECONDS, supervisor.SHUTDOWN_SECONDS, "a detector is killed as its end is stored"),
    (socket.RECONNECT_MOST_SECONDS, control.ANSWER_SECONDS, "a pipeline that has just started counts as absent"),
    (commands.RETRY_SECONDS, control.ANSWER_SECONDS, "a command is sent once to a detector that was not connected"),
    (go_back_n.PATIENCE_SECONDS, go_back_n.AGAIN_SECONDS, "a restarted receiver is sent everything twice"),
    (go_back_n.PATIENCE_SECONDS, socket.LINGER_SECONDS, "a sender that closes transmits nothing again"),
    (newest.REPEAT_SECONDS, subscription.REPORT_SECONDS, "a health report that was lost is not repeated in time"),
    (subscription.CHECK_SECONDS, subscription.REPORT_SECONDS, "a pipeline that rejects the keys counts as silent"),
    (process.HEALTH_SECONDS, subscription.REPORT_SECONDS, "a client that waits for a health report receives none"),
    (process.TURN_SECONDS, go_back_n.PATIENCE_SECONDS, "a receiver asks a detector that waits a second time"),
    (app.UPDATE_SECONDS, server.SHUTDOWN_SECONDS, "the server closes a page before it is told of its end"),
    (dashboard.POINT_SECONDS, dashboard.RATE_SECONDS, "a chart of frames per second leaves out frames"),
    (subscription.CHECK_SECONDS, feed.SILENCE_SECONDS, "a page with keys that are rejected says that it is silent"),
    (subscription.DRAIN_SECONDS, feed.DRAIN_SECONDS, "the last messages are dropped before their subscriptions end"),
    (app.RETRY_SECONDS, feed.IDLE_SECONDS, "the feed of a stream is closed while its page connects again"),
    (store.STORE_SECONDS, fleet.ANSWER_SECONDS, "a store that cannot be reached seems to be a controller that hangs"),
    (supervisor.SHUTDOWN_SECONDS + store.STORE_SECONDS, life.STOPPING_SECONDS, "a stream that stores is killed"),
    (life.STOPPING_SECONDS, fleet.DOWN_SECONDS, "`down` ends before a stream that hangs was killed"),
    (controller.PLACED_SECONDS, fleet_commands.UP_SECONDS, "`up` ends before it says that Ray places no stream"),
    (controller.QUIET_SECONDS, life.SILENT_SECONDS, "a stream is started again before it is said that it is silent"),
]


@pytest.mark.parametrize(("shorter", "longer", "otherwise"), ORDER, ids=[row[2] for row in ORDER])
def test_a_time_limit_is_shorter_than_those_that_build_on_it(shorter, longer, otherwise):
    assert 0 < shorter < longer, f"otherwise {otherwise}"


def test_the_docs_say_after_which_time_a_process_is_silent_and_a_stream_is_started_again():
    assert f"within {feed.SILENCE_SECONDS:g} s" in (DOCS / "how-to" / "view.md").read_text()
    pause = f"a pause of {actor.FIRST_PAUSE_SECONDS:g} s to {actor.LONGEST_PAUSE_SECONDS:g} s"
    assert pause in (DOCS / "how-to" / "fleet.md").read_text()


def test_a_host_that_disappears_is_noticed_after_the_time_that_the_docs_say():
    page = " ".join((DOCS / "architecture.md").read_text().split())  # wherever its lines end
    seconds = socket.KEEPALIVE_SECONDS + socket.KEEPALIVE_PROBES * socket.KEEPALIVE_PROBE_SECONDS
    assert f"starts after {socket.KEEPALIVE_SECONDS:g} s without traffic" in page
    assert f"closed after {seconds:g}" in page
