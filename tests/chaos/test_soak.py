"""A soak: a million published messages and subscribers that come and go leave nothing in the publishing process."""

from contextlib import suppress
from itertools import count
from pathlib import Path

import psutil
import pytest

from catstream.client.subscription import Subscription
from catstream.errors import SilenceError
from catstream.wire.channels import TRACKS
from catstream.wire.messages import Track
from catstream.wire.newest import Publisher


def handles() -> int:
    """Open file descriptors and mappings of shared memory of this process."""
    return psutil.Process().num_fds() + Path("/proc/self/maps").read_text().count("/dev/shm/")


def publish_to_visitors(send, endpoint) -> None:
    """Publish bursts; one subscriber reads the newest track of each, another one reads nothing until it leaves."""
    with Subscription(endpoint, "tracks", newest=True, timeout=0.02) as reader, Subscription(endpoint, "tracks"):
        track = None
        while track is None:  # the reader has not joined
            send()
            with suppress(SilenceError):
                track = next(reader)
        reader.timeout = None
        for _ in range(10):
            last = [send() for _ in range(500)][-1]  # they fit into the queue of a subscriber
            while next(reader).frame < last:
                pass


@pytest.mark.slow  # 40 s of processor time
def test_million_messages_leave_memory_and_handles_constant(endpoint, until):
    frames = count()
    with Publisher(TRACKS, endpoint) as publisher:

        def send() -> int:
            publisher.send(Track(frame := next(frames), 0.0, "absent", None, 0.1, 1))
            return frame

        handles_before, memory = handles(), []
        for messages in (10**5, 10**6):
            while send() < messages:
                publish_to_visitors(send, endpoint)
            memory.append(psutil.Process().memory_info().rss)
        assert memory[1] - memory[0] < 10 << 20
        until(lambda: handles() <= handles_before + 5, publisher.serve_late_joiners)  # the last visitors disconnect
