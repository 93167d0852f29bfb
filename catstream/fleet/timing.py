"""The time limits of a fleet, in one table, and the order that they must keep."""

from __future__ import annotations

from catstream.messages.storage import ABANDONED_SECONDS
from catstream.services.supervisor import SHUTDOWN_SECONDS
from catstream.wire.commands import RETRY_SECONDS

# The controller.
TURN_SECONDS = 0.5  #: between two looks at the actors
REPORT_SECONDS = 0.1  #: longest wait of a look for the reports of all streams
QUESTION_SECONDS = 0.1  #: between two looks at the questions of the registry
CLIENTS_SECONDS = 5.0  #: between two looks at the keys of the clients
QUIET_SECONDS = 5.0  #: without an answer of a stream, after which the status says so
SILENT_SECONDS = 120.0  #: the same, after which it is started again: a busy machine may be slow to answer
STOPPING_SECONDS = 30.0  #: limit for a stream to store its last state and to end, before it is killed
PAUSE_SECONDS = 5.0  #: between two starts of one actor, at least: one may die each time, or be superseded
ADOPTED_SECONDS = 30.0  #: limit for an actor that an earlier controller has started to say what it was started for
LOGS_SECONDS = 10.0  #: limit for a stream to answer with its log

# A stream.
TRACKS_SECONDS = 0.1  #: longest wait for a frame
FIRST_PAUSE_SECONDS = 1.0  #: before a stream that failed starts again; doubled each time
LONGEST_PAUSE_SECONDS = 60.0  #: the most of these
FORGOTTEN_SECONDS = 60.0  #: of running, after which earlier failures do not count
RATE_SECONDS = 5.0  #: over which rates are measured
BEGIN_SECONDS = 2.0  #: from the claim of a stream to its first frame; they count as lost

# The store.
STORE_SECONDS = 10.0  #: limit of a whole call
CONNECT_SECONDS = 3.0  #: limit to connect to the server

# Commands.
REACH_SECONDS = 3.0  #: limit to connect to the head
ANSWER_SECONDS = 60.0  #: limit for the controller to answer; Ray starts it again meanwhile, if it has died
DOWN_SECONDS = 60.0  #: limit for all streams to store their state and to end
ENDED_SECONDS = 0.2  #: between two looks whether they have ended
UP_SECONDS = 120.0  #: limit for the streams to start, after which `up` waits no longer
SHOW_SECONDS = 0.5  #: between two pictures of the status

# A cluster on one machine.
CLUSTER_START_SECONDS = 150.0  #: limit for Ray to start, on a machine that is busy
CLUSTER_END_SECONDS = 30.0  #: limit for it to end before it is killed
CLUSTER_LOOK_SECONDS = 0.05  #: between two looks whether it has started or ended
NODES_SECONDS = 0.5  #: between two looks at its nodes
RETURN_SECONDS = 10.0  #: from the death of a node to its next start: its streams, which start elsewhere, come first
HEALTH_DELAY_SECONDS = 1.0  #: before the first health check of a node
HEALTH_SECONDS = 0.5  #: between two of them
HEALTH_ANSWER_SECONDS = 1.5  #: limit for an answer
HEALTH_FAILURES = 3  #: one after the other, after which a node counts as dead

#: A limit, a longer one, and what goes wrong otherwise.
ORDER: tuple[tuple[float, float, str], ...] = (
    (QUESTION_SECONDS, RETRY_SECONDS, "a client repeats each question to the registry"),
    (REPORT_SECONDS, TURN_SECONDS, "one stream that hangs makes the looks at all others rare"),
    (TURN_SECONDS, QUIET_SECONDS, "a stream that answers in each turn seems not to answer"),
    (QUIET_SECONDS, SILENT_SECONDS, "a stream is started again before the status says that it does not answer"),
    (
        HEALTH_DELAY_SECONDS + HEALTH_FAILURES * (HEALTH_SECONDS + HEALTH_ANSWER_SECONDS),
        SILENT_SECONDS,
        "a stream of a dead node is started again before Ray has noticed its death",
    ),
    (SHUTDOWN_SECONDS + STORE_SECONDS, STOPPING_SECONDS, "a stream is killed while it stores its last state"),
    (STOPPING_SECONDS, DOWN_SECONDS, "`down` ends before a stream that hangs was killed"),
    (PAUSE_SECONDS, ADOPTED_SECONDS, "an actor that an earlier controller has just started is replaced"),
    (TURN_SECONDS, ADOPTED_SECONDS, "an actor of an earlier controller is replaced before it was asked"),
    (LOGS_SECONDS, ANSWER_SECONDS, "a stream that hangs seems to be a controller that hangs"),
    (STORE_SECONDS, ANSWER_SECONDS, "a store that cannot be reached seems to be a controller that hangs"),
    (CONNECT_SECONDS, STORE_SECONDS, "an error of the store does not say that its server cannot be reached"),
    (STORE_SECONDS, ABANDONED_SECONDS, "a part of a file is removed while it is written"),
    (FIRST_PAUSE_SECONDS, LONGEST_PAUSE_SECONDS, "the pauses of a stream that fails do not grow"),
    (TRACKS_SECONDS, RATE_SECONDS, "rates are measured over no frame"),
    (CLUSTER_LOOK_SECONDS, CLUSTER_END_SECONDS, "a cluster that has ended is killed"),
    (CLUSTER_END_SECONDS, CLUSTER_START_SECONDS, "a cluster that starts while another one ends does not wait for it"),
    (NODES_SECONDS, RETURN_SECONDS, "a node starts again while the streams that it had start elsewhere"),
    (SHOW_SECONDS, UP_SECONDS, "`up` shows no stream"),
)
