"""The watchdog: a long step has to be announced."""

from contextlib import closing

from catstream.processes.shared import LONG_SECONDS, RUNNING_SECONDS, SharedMemory


def test_watchdog_allows_announced_long_steps():
    with closing(SharedMemory()) as memory:
        watchdog = memory.watchdog
        assert watchdog.patience == LONG_SECONDS, "a start takes long"
        loop = SharedMemory(memory.handle).watchdog
        before = watchdog.iterations
        loop.beat()
        assert (watchdog.iterations, watchdog.patience) == (before + 1, RUNNING_SECONDS)
        loop.allow(300)
        assert watchdog.patience == 300
        loop.limit += 6  # each turn skips frames of the source
        loop.beat()
        assert watchdog.patience == RUNNING_SECONDS + 6
