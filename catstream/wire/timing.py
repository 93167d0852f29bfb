"""The time limits of the sockets and of their clients, in one table, and the order that they must keep."""

from __future__ import annotations

# Connections, as libzmq and TCP keep them.
RECONNECT_SECONDS = 0.02  #: before the first attempt to connect again; doubled each time
RECONNECT_MOST_SECONDS = 0.5  #: between two attempts at most
HANDSHAKE_SECONDS = 5.0  #: limit for a peer to prove its key
KEEPALIVE_SECONDS = 5.0  #: without traffic, after which TCP probes the other host
KEEPALIVE_PROBE_SECONDS = 2.0  #: between two probes
KEEPALIVE_PROBES = 3  #: without an answer, after which the connection is closed
LINGER_SECONDS = 2.0  #: that a closed socket still has to transmit its last messages

# Acknowledged channels.
PATIENCE_SECONDS = 0.2  #: without a reply, after which a sender asks for the position; between two reports of a gap
AGAIN_SECONDS = 2.0  #: within which a sender goes back once only on the same connection

# Published channels.
REPEAT_SECONDS = 0.2  #: without a newer message, after which the last ones are sent again; doubled each time
EARLY_SECONDS = 5.0  #: limit for early subscribers to connect before the first frame

# Questions and their answers.
LOOK_SECONDS = 0.05  #: from one look at the connection to the next
RETRY_SECONDS = 0.2  #: after which a question is sent again; a large one later
RETRY_BYTES_PER_SECOND = 1e6  #: of a slow network: a large question is sent again after so much longer

# Clients.
ANSWER_SECONDS = 5.0  #: limit for the answer to a command, and of a registry, by default
DESERTED_SECONDS = 1.0  #: for an answer from a folder in which no pipeline seems to run; its detector may be restarted
REGISTRY_SECONDS = 1.0  #: for the registry before each command; without an answer, the stream has not moved
CONTROLLER_SECONDS = 0.5  #: without an answer, after which the endpoint of a fleet on this machine is read again
QUIET_SECONDS = 1.0  #: without a message, after which the registry is asked where a stream runs; then repeated
CHECK_SECONDS = 1.0  #: between two checks of a connection, which report whether the pipeline has rejected the keys
DRAIN_SECONDS = 0.5  #: for messages after the end, which arrives on a connection of its own and may overtake them
REPORT_SECONDS = 5.0  #: for a health report, by default; each process of a running pipeline sends one every second

#: A limit, a longer one, and what goes wrong otherwise.
ORDER: tuple[tuple[float, float, str], ...] = (
    (RECONNECT_SECONDS, PATIENCE_SECONDS, "a sender asks a receiver that was restarted before it is connected again"),
    (RECONNECT_MOST_SECONDS, EARLY_SECONDS, "the first frame does not wait until an early subscriber has connected"),
    (RECONNECT_MOST_SECONDS, DESERTED_SECONDS, "a pipeline that has just started counts as absent"),
    (LOOK_SECONDS, RETRY_SECONDS, "a question is sent again for nothing, as its connection broke"),
    (RETRY_SECONDS, CONTROLLER_SECONDS, "a question is sent once to a controller that was not connected yet"),
    (RETRY_SECONDS, DESERTED_SECONDS, "a command is sent once to a detector that was not connected yet"),
    (CONTROLLER_SECONDS, REGISTRY_SECONDS, "a command does not follow a controller that was started again elsewhere"),
    (DESERTED_SECONDS, ANSWER_SECONDS, "a command to a restarted detector is not repeated"),
    (REGISTRY_SECONDS, ANSWER_SECONDS, "a command waits longer for the registry than for its answer"),
    (PATIENCE_SECONDS, AGAIN_SECONDS, "a sender transmits everything twice to a receiver that was restarted"),
    (PATIENCE_SECONDS, LINGER_SECONDS, "a sender that closes transmits nothing again"),
    (REPEAT_SECONDS, REPORT_SECONDS, "a health report that was lost is not repeated in time"),
    (CHECK_SECONDS, REPORT_SECONDS, "a pipeline that rejects the keys counts as silent"),
)
