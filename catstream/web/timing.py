"""The time limits of the web page, in one table, and the order that they must keep."""

from __future__ import annotations

# Connections of browsers.
REQUEST_SECONDS = 5.0  #: limit for a client to send a request, and again for its body
ANSWER_SECONDS = 20.0  #: without reading its response, after which a client is disconnected
SHUTDOWN_SECONDS = 2  #: limit for the responses to end when the server does

# Updates of open pages.
UPDATE_SECONDS = 0.1  #: between two updates
KEEP_ALIVE_SECONDS = 5.0  #: without an update, after which a comment is sent, which detects closed connections
RETRY_SECONDS = 1.0  #: after which a page whose connection broke connects again

# The page of a pipeline.
POINT_SECONDS = 0.25  #: between two points of the charts
RATE_SECONDS = 2.0  #: over which frames per second are counted
APART_SECONDS = 1.0  #: in the video, between two surprising frames, because neighbouring frames are similar

# The connection to a pipeline.
SILENCE_SECONDS = 4.0  #: without a health report, after which a process is silent; each sends one every second
DRAIN_SECONDS = 2.0  #: for the last messages to arrive after the end
PAUSE_SECONDS = 0.5  #: before a pipeline is looked up again

# A fleet, its streams and their pictures.
PERIOD_SECONDS = 1.0  #: between two questions to the registry
REGISTRY_SECONDS = 2.0  #: limit for its answer
IDLE_SECONDS = 60.0  #: after which the feed of a stream that nobody looks at is closed
FRESH_SECONDS = 1.0  #: within which a picture is not made again
FIRST_SECONDS = 2.0  #: limit for the first preview of a stream, which may be an old one
NEXT_SECONDS = 0.4  #: limit for the second one

#: A limit, a longer one, and what goes wrong otherwise.
ORDER: tuple[tuple[float, float, str], ...] = (
    (UPDATE_SECONDS, SHUTDOWN_SECONDS, "the server closes a page before the page is told that the server ends"),
    (UPDATE_SECONDS, KEEP_ALIVE_SECONDS, "a page is sent comments between its updates"),
    (KEEP_ALIVE_SECONDS, ANSWER_SECONDS, "an idle page that is gone is noticed later than one that does not read"),
    (POINT_SECONDS, RATE_SECONDS, "a chart of frames per second leaves out frames"),
    (RETRY_SECONDS, IDLE_SECONDS, "the feed of a stream is closed while its page connects again"),
    (FIRST_SECONDS + NEXT_SECONDS, ANSWER_SECONDS, "a client is disconnected while it waits for a picture"),
)
