"""The watchdog: who is slow is given time, who stands still is noticed."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages import Run
from catstream.services import compressor, detector
from catstream.services.watchdog import PATIENCE, Watchdog
from catstream.settings import Settings
from catstream.wire.endpoint import Endpoint


@pytest.fixture
def watchdog():
    watchdog = Watchdog()
    yield watchdog
    watchdog.close()


def test_who_watches_sees_each_turn(watchdog):
    loop = Watchdog(watchdog.handle)
    for turn in range(1, 4):
        loop.beat()
        assert watchdog.turns == turn
    assert watchdog.patience == PATIENCE


def test_who_is_starting_has_longer_than_who_turns(watchdog):
    assert watchdog.patience > 20 * PATIENCE


def test_a_long_step_that_is_announced_has_its_time_and_the_next_has_not(watchdog):
    watchdog.beat()
    watchdog.allow(60)
    assert watchdog.patience == 60
    watchdog.beat()
    assert watchdog.patience == PATIENCE


def test_where_turns_are_slow_patience_is_longer_until_they_are_quick_again(watchdog, monkeypatch):
    clock = [time.monotonic()]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    for seconds in (0.0, 0.0, 4.0):
        clock[0] += seconds
        watchdog.beat()
    assert watchdog.patience == pytest.approx(20, rel=0.1)
    for _ in range(500):
        watchdog.beat()
    assert watchdog.patience == PATIENCE


def test_where_each_turn_is_longer_each_has_its_time(watchdog):
    watchdog.allow_each(6)
    for _ in range(3):
        watchdog.beat()
        assert watchdog.patience == PATIENCE + 6
    watchdog.allow(60)
    assert watchdog.patience == 60


@pytest.fixture
def allowed(folder):
    """Stands for a process, and only notes the seconds that it asks for."""
    process = SimpleNamespace(
        settings=Settings(), run=Run.of(Settings().portable()), endpoint=Endpoint.parse(str(folder))
    )
    process.seconds, process.each = [], []
    process.allow, process.allow_each = process.seconds.append, process.each.append
    return process


def gone(*_, **__):
    raise VideoError("as far as this test goes")


@pytest.mark.parametrize(
    ("part", "went_on_at", "passed_over", "each"),
    [
        (slice(None), 0, 0, 0),
        (slice(900, None), 0, 900, 0),
        (slice(900, None, 60), 0, 900, 59),
        (slice(900, None, 60), 11, 900 + 10 * 60, 59),
    ],
)
def test_a_detector_has_time_for_each_frame_of_the_file_that_it_passes_over(
    allowed, monkeypatch, part, went_on_at, passed_over, each
):
    monkeypatch.setattr(detector, "open_source", gone)
    monkeypatch.setattr(detector._Line, "resume", lambda _, found, __: setattr(found, "seq", went_on_at))
    with pytest.raises(VideoError, match="as far as"):
        detector.main(allowed, "walk.mp4", Box(1, 1, 9, 9), None, resume=True, owned=False, part=part)
    assert allowed.seconds == [pytest.approx(60 + 0.1 * passed_over)]
    assert allowed.each == [pytest.approx(0.1 * each)]


def test_a_compressor_has_time_to_read_the_recording_that_it_goes_on_with(allowed, monkeypatch, tmp_path):
    with (tmp_path / "run.rec").open("wb") as file:
        file.truncate(5_000_000_000)
    monkeypatch.setattr(compressor, "RecordingWriter", gone)
    with pytest.raises(VideoError, match="as far as"):
        compressor.main(allowed, None, None, tmp_path / "run.rec")
    assert allowed.seconds[0] >= 500
