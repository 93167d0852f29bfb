"""A recording that is played is to subscribers what the pipeline was."""

from __future__ import annotations

import threading
import time

import pytest

import catstream
from catstream.box import Box
from catstream.client.subscription import wait_until_running
from catstream.messages.kinds import End, Features, Health, Model, Track
from catstream.sinks.recording.file import Recording
from catstream.sinks.recording.player import Player
from catstream.wire.channels import HEALTH, TRACKS, TRAINING
from catstream.wire.codec import encode
from catstream.wire.newest import Publisher, Subscriber


@pytest.fixture
def playing(endpoint):
    """Plays a recording to who listens, in a thread."""

    def play(recording):
        with Player(recording, endpoint) as player:
            player.wait()
            list(player.play(None))

    threads = []

    def start(recording):
        threads.append(threading.Thread(target=play, args=(recording,), daemon=True))
        threads[-1].start()

    yield start
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()


def test_waiting_for_a_pipeline_is_no_subscription_to_its_tracks(endpoint, until):
    found = []
    with Publisher(TRACKS, endpoint) as tracks, Publisher(HEALTH, endpoint, "detector") as health:
        waits = threading.Thread(target=lambda: found.append(wait_until_running(str(endpoint), seconds=30)))
        waits.start()

        def turn():
            health.send(Health("detector", time.time()))
            tracks.serve_late_joiners()
            assert not tracks.has_subscribers, "a replay that waits for a subscriber would begin now"
            time.sleep(0.01)

        until(lambda: found, turn)
        waits.join(30)
    assert str(found[0]) == str(endpoint)


def test_a_subscriber_receives_all_recorded_messages_until_the_end(said, written, playing, endpoint):
    end = End(51, "the source has ended", totals={"sent": 50.0})
    playing(Recording(written([*said, end])))
    with catstream.subscribe(str(endpoint), "tracks", timeout=30) as tracks:
        heard = list(tracks)
    assert list(map(encode, heard)) == [encode(message) for message in said if isinstance(message, Track)]
    assert tracks.end == end
    assert tracks.missed == 0


def test_each_replay_is_a_run_of_its_own(said, written, endpoint):
    recording, runs = Recording(written(said)), []
    for _ in range(2):
        with Subscriber(TRACKS, endpoint) as tracks, Player(recording, endpoint) as player:
            player.wait()
            list(player.play(None))
            assert tracks.receive(10) is not None
            runs.append(tracks.run)
    assert "" not in runs
    assert runs[0] != runs[1], "a page that shows the first one has to begin anew"


def test_a_subscriber_to_one_object_receives_its_recorded_tracks_and_no_others(said_of_two, written, playing, endpoint):
    playing(Recording(written([*said_of_two, End(51, "the source has ended")])))
    with catstream.subscribe(str(endpoint), "tracks", object="ben", timeout=30) as tracks:
        heard = list(tracks)
    assert [(track.object, track.frame) for track in heard] == [("ben", frame) for frame in range(20, 50)]
    assert tracks.missed == 0


def test_features_and_settings_travel_too_and_a_cut_recording_has_an_end(said, written, playing, endpoint):
    recording = Recording(written([message for message in said if not isinstance(message, Model)][:40]))
    with Subscriber(TRAINING, endpoint) as training, Subscriber(TRACKS, endpoint):
        playing(recording)
        heard, deadline = [], time.monotonic() + 30
        while not (heard and isinstance(heard[-1], End)) and time.monotonic() < deadline:
            if (message := training.receive(0.1)) is not None:
                heard.append(message)
    assert recording.run in heard
    seqs = [message.seq for message in heard if isinstance(message, Features)]
    assert seqs == list(range(21 - len(seqs), 21))
    assert (heard[-1].seq, heard[-1].reason) == (21, "the recording ends here")


def test_it_is_not_played_faster_than_wanted(written, endpoint, monkeypatch):
    moments = iter([99.0, 100.0, 101.0, 104.0])
    track = Track(1, 0, 0.0, "present", Box(1.0, 2.0, 3.0, 4.0), 0.5, 0)
    with monkeypatch.context() as clock:
        clock.setattr("catstream.sinks.recording.file.time.time_ns", lambda: int(1e9 * next(moments)))
        path = written([track, Health("trainer", 101.0), Health("detector", 104.0)])
    with Player(Recording(path), endpoint) as player:
        started = time.monotonic()
        played = list(player.play(20.0))
    assert time.monotonic() - started >= (104 - 100) / 20
    assert [type(message) for message in played] == [Track, Health, Health, End]
