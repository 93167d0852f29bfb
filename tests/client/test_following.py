"""A subscriber to a stream of a fleet stays attached when the stream moves, and returns each frame once."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace

import pytest

import catstream
from catstream.errors import ServiceError, SilenceError
from catstream.wire.channels import TRACKS
from catstream.wire.discovery import private_folder
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, FleetStatus, StreamStatus
from catstream.wire.newest import Publisher
from tests.wire.examples import present as track

STOPPED = End(98, "it was stopped by a command")


class Stream:
    """A stream of a fleet, its pipelines, and a subscriber in a thread."""

    def __init__(self, until, pool, stack):
        self.status = FleetStatus("site", 1.7e9, {"cam-7": StreamStatus("cam-7", "starting", source="walk.mp4")})
        self._until, self._pool, self._stack = until, pool, stack

    def update(self, **changes):
        """Change the entry of the stream in the registry."""
        self.status.streams["cam-7"] = replace(self.status.streams["cam-7"], **changes)

    def runs(self, keys="", text="", **changes):
        """The tracks of a new pipeline of the stream, which runs now."""
        place = Endpoint.parse(text or str(self._stack.enter_context(private_folder())), keys)
        publisher = self._stack.enter_context(Publisher(TRACKS, place))
        token = self.status.streams["cam-7"].token + 1
        self.update(**{"state": "running", "endpoint": str(place), "token": token} | changes)
        return publisher

    def send(self, publisher, *messages):
        """Send once the subscriber is connected to this pipeline."""
        self._until(lambda: b"" in publisher._subscribed, publisher.serve_late_joiners)
        for message in messages:
            publisher.send(message)

    def watched(self, subscription):
        """Everything that the subscription returns until it ends."""
        return self._pool.submit(list, subscription)


@pytest.fixture
def stream(until):
    with ExitStack() as stack, ThreadPoolExecutor(1) as pool:
        yield Stream(until, pool, stack)


def test_subscription_follows_its_stream_and_returns_frames_once(stream, managing):
    with managing(stream.status):
        first = stream.runs()
        with catstream.subscribe("fleet://cam-7", "tracks", timeout=500) as tracks:
            watched = stream.watched(tracks)
            stream.send(first, *(track(seq, name) for seq in range(1, 6) for name in ("anna", "ben")), STOPPED)
            second = stream.runs()
            stream.send(second, *(track(seq, name) for seq in range(3, 9) for name in ("anna", "ben")))
            second.close()  # its node dies: frames are lost
            stream.send(stream.runs(), track(11, "anna"), STOPPED)
            stream.update(state="ended", endpoint="")
            expected = [track(seq, name) for seq in range(1, 9) for name in ("anna", "ben")]
            assert watched.result(500) == [*expected, track(11, "anna")]
            assert (tracks.missed, tracks.end) == (2 + 99 - 12, STOPPED)


def test_tracks_before_a_registered_end_are_read(stream, managing):
    with managing(stream.status):
        first = stream.runs()
        with catstream.subscribe("fleet://cam-7", "tracks", timeout=500) as tracks:
            stream.send(first, track(1), STOPPED)
            stream.update(state="ended")
            tracks._update(stream.status.streams["cam-7"])  # before anything is read
            assert list(tracks) == [track(1)]
            assert (tracks.end, tracks.missed) == (STOPPED, 99 - 2)


def test_subscription_continues_without_the_controller(stream, managing, folder):
    place = str(folder / "registry")  # the same for each controller of a fleet
    with ExitStack() as controller:
        controller.enter_context(managing(stream.status, place))
        first = stream.runs()
        with catstream.subscribe("fleet://site/cam-7", "tracks", timeout=500) as tracks:
            watched = stream.watched(tracks)
            stream.send(first, track(1))
            controller.close()
            stream.send(first, track(2), STOPPED)
            second = stream.runs()
            with managing(stream.status, place):
                stream.send(second, track(3))
                del stream.status.streams["cam-7"]
                assert watched.result(500) == [track(1), track(2), track(3)]
            assert tracks.end.reason == "the stream cam-7 was removed from the fleet site, or the fleet is down"


def test_subscription_waits_for_a_stream_that_does_not_run_yet(stream, managing):
    stream.update(state="failed", trouble="there is no camera")
    with managing(stream.status), catstream.subscribe("fleet://cam-7", "tracks", timeout=0.1) as tracks:
        with pytest.raises(SilenceError, match=r"the state of the stream is: failed, there is no camera$"):
            next(tracks)
        tracks.timeout = 60
        watched = stream.watched(tracks)
        stream.send(stream.runs(), track(1), STOPPED)
        stream.update(state="ended")
        assert watched.result(500) == [track(1)]


@pytest.mark.parametrize("change", [{"source": "run.mp4"}, {"live": True}])
def test_all_frames_of_another_or_live_source_are_returned(stream, managing, change):
    """A live stream uses the numbers of the frames that it lost again."""
    with managing(stream.status):
        first = stream.runs()
        with catstream.subscribe("fleet://cam-7", "tracks", timeout=500) as tracks:
            watched = stream.watched(tracks)
            stream.send(first, track(1), track(2))
            first.close()
            stream.send(stream.runs(**change), track(1), track(2), STOPPED)
            stream.update(state="ended")
            assert [message.seq for message in watched.result(500)] == [1, 2, 1, 2]


def test_missing_or_ended_stream_is_not_waited_for(stream, managing):
    with managing(stream.status):
        with pytest.raises(ServiceError, match="site has no stream 'cam-8': its streams are cam-7"):
            catstream.subscribe("fleet://cam-8", "tracks")
        stream.update(state="ended")
        with catstream.subscribe("fleet://cam-7", "tracks", timeout=500) as tracks:
            assert list(tracks) == []
            assert tracks.end.reason == "the stream cam-7 has ended"
