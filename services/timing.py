"""The time limits of the processes of a pipeline, in one table, and the order that they must keep."""

from __future__ import annotations

# Turns of loops.
TURN_SECONDS = 0.02  #: the longest wait in a turn of a detector; from one look at the processes of a run to the next
MESSAGE_SECONDS = 0.1  #: the longest wait of compressor and trainer for a message
LOOK_SECONDS = 0.01  #: from one look at a process that starts or ends to the next
HEALTH_SECONDS = 1.0  #: between two health reports of a process
PREVIEW_SECONDS = 0.1  #: shortest time between two pictures for subscribers
SAVED_MODEL_SECONDS = 1.0  #: shortest time between two files of one object, for subscribers that save it

# The watchdog of a process.
STUCK_SECONDS = 2.5  #: without a turn, after which a loop with short turns counts as stuck
LONGEST_STUCK_SECONDS = 60.0  #: the most of these that follows from slow turns
STOPPED_SECONDS = 2.0  #: after which a process that SIGSTOP has stopped counts as stuck
STEP_SECONDS = 0.5  #: the most that counts between two looks at a process, as the parent may have been suspended

# What a turn may take that the process has announced to its watchdog.
START_SECONDS = 120.0  #: for imports and compiling kernels
OPEN_SECONDS = 60.0  #: for opening the source, for the first frame, and for an object that begins
SKIP_SECONDS = 0.1  #: for decoding a skipped frame
MODEL_SECONDS = 60.0  #: for reading saved models, training from them, and writing them to a slow disk
TRAIN_SECONDS = 60.0  #: for training a model
STORE_SECONDS = 60.0  #: for writing a checkpoint to a slow disk
CLOSE_SECONDS = 30.0  #: for closing all sockets after the last turn

# Restarts.
RESTART_SECONDS = 0.1  #: before the second restart in a minute; doubled for each further one
RESTARTS, RECENT_SECONDS = 5, 60.0  #: how often a process may be restarted, and in which time
LOCK_SECONDS = 10.0  #: limit for an earlier compressor to end
SHARED_SECONDS = 10.0  #: limit for a shared start server to listen, before its imports

# The end.
FEATURES_END_SECONDS = 10.0  #: limit for the end of the features to be stored, once the detector was asked to end
RESULTS_END_SECONDS = 0.5  #: the same for the end of the tracks to be received by the owner of the run
SENDER_SECONDS = 5.0  #: limit for the detector to send the end, once the compressor was asked to end
TRACKS_END_SECONDS = 5.0  #: limit for the end of the tracks to be recorded, once the detector has disconnected
APART_SECONDS = 3.0  #: the most between the end of another process and that of the detector that delivers nothing more
SHUTDOWN_SECONDS = 12.0  #: limit for all processes to end before they are killed
EXIT_SECONDS = 12.0  #: limit for the detector to exit after the end of the stream was received
KILLED_SECONDS = 5.0  #: limit for the end of a process that was killed

#: A limit, a longer one, and what goes wrong otherwise.
ORDER: tuple[tuple[float, float, str], ...] = (
    (MESSAGE_SECONDS, STUCK_SECONDS, "a process without messages counts as stuck"),
    (TURN_SECONDS, MESSAGE_SECONDS, "a process that died is restarted after the others have noticed it"),
    (STEP_SECONDS, STOPPED_SECONDS, "a process counts as stopped because its parent was suspended once"),
    (STEP_SECONDS, STUCK_SECONDS, "a process counts as stuck because its parent was suspended once"),
    (STUCK_SECONDS, LONGEST_STUCK_SECONDS, "the turns on a slow machine get no more time"),
    (RESTART_SECONDS * 2**RESTARTS, RECENT_SECONDS, "a process that dies after each start is restarted for ever"),
    (LOOK_SECONDS, SHARED_SECONDS, "a program does not wait for the shared server that another one is starting"),
    (KILLED_SECONDS, LOCK_SECONDS, "a compressor fails because the one before it has just been killed"),
    (STEP_SECONDS, APART_SECONDS, "a process is started again because its parent was suspended once"),
    (RESULTS_END_SECONDS, APART_SECONDS, "a compressor is restarted while the detector waits for the owner"),
    (FEATURES_END_SECONDS + RESULTS_END_SECONDS, SHUTDOWN_SECONDS, "a detector is killed while its end is stored"),
)
