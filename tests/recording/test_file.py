"""The file of a recording: what was written is read, but for what a crash cut off or a disk damaged."""

from __future__ import annotations

import resource

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.box import Box
from catstream.errors import RecordingError
from catstream.messages import End, Features, Health, Model, Track
from catstream.recording.file import Recording, RecordingWriter, run_of
from catstream.settings import Settings
from catstream.wire.codec import encode


def features(seq, value=0.5):
    rows = np.full((1, 3), value, np.float32)
    return Features(seq, seq - 1, 0.0, None, rows, rows[0, :1], rows[0, :1], rows[:0], rows[:0, 0])


def track(seq):
    return Track(seq, seq - 1, seq / 30, "present", Box(1.0, 2.0, 3.0, 4.0), 0.9, 1)


def model(version, frame):
    return Model(version, frame, np.full(3, version, np.float32), 0.5)


def read(path):
    return [message for _, message in Recording(path).messages()]


def test_what_was_written_is_read_with_the_settings(written):
    settings = Settings(coreset={"size": 32}, teaching={"classifier": "one-class"}, run={"endpoint": "somewhere"})
    messages = [track(1), features(1), model(1, 0), Health("trainer", 2.0, {"trained": 1.0}), End(2, "its end")]
    recording = Recording(written(messages, settings))
    run, *others = (message for _, message in recording.messages())
    assert recording.settings == settings.but({"run.endpoint": ""})
    assert run == recording.run
    assert list(map(encode, others)) == list(map(encode, messages))
    assert recording.end == messages[-1]
    assert recording.torn == 0


def test_a_crash_at_any_byte_leaves_all_records_before_it(written, tmp_path):
    messages = [track(1), features(1), model(1, 0), track(2), features(2)]
    path = written([])
    ends = [path.stat().st_size]
    for message in messages:
        written([message], resume=True)
        ends.append(path.stat().st_size)
    whole, cut = path.read_bytes(), tmp_path / "cut.rec"
    for size in range(ends[0], ends[-1] + 1):
        cut.write_bytes(whole[:size])
        kept = sum(end <= size for end in ends[1:])
        assert [type(message) for message in read(cut)[1:]] == [type(message) for message in messages[:kept]]
        assert Recording(cut).torn == size - ends[kept]
        assert not any(Recording(cut).missing.values())


@pytest.mark.parametrize("size", [0, 5, 8, 60, 500])
def test_what_was_torn_before_the_settings_is_no_recording(written, size):
    path = written([])
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(RecordingError):
        Recording(path)


@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_changed_bit_costs_its_own_message_and_no_other(tmp_path_factory, share, bit):
    path = tmp_path_factory.mktemp("changed") / "run.rec"
    with RecordingWriter(path, run_of(Settings())) as writer:
        begin = path.stat().st_size
        for seq in range(1, 10):
            writer.write(track(seq))
    content = bytearray(path.read_bytes())
    size = (len(content) - begin) // 9
    place = int(share * 9 * size)
    content[begin + place] ^= 1 << bit
    path.write_bytes(content)
    recording, changed = Recording(path), place // size + 1
    assert read(path)[1:] == [track(seq) for seq in range(1, 10) if seq != changed]
    assert (recording.damaged, recording.torn) == ((0, size) if changed == 9 else (size, 0))
    assert f"{size} {'torn' if changed == 9 else 'damaged'} bytes" in str(recording)


def test_it_goes_on_after_the_last_whole_record(written):
    path = written([features(1), features(2)])
    path.write_bytes(path.read_bytes()[:-7])
    written([features(2), features(3)], resume=True)
    recording = Recording(path)
    assert [message.seq for message in recording.features()] == [1, 2, 3]
    assert recording.torn == 0


def test_what_a_restarted_compressor_took_anew_replaces_what_it_had_taken(written):
    path = written([features(1), model(1, 0), features(2), features(3, 0.125), model(2, 2)])
    written([features(3, 0.75), model(2, 2), features(4)], resume=True)
    recording = Recording(path)
    taken = [(message.seq, float(message.rows[0, 0])) for message in recording.features()]
    assert taken == [(1, 0.5), (2, 0.5), (3, 0.75), (4, 0.5)]
    assert [model.version for model in recording.models()] == [1, 2]
    assert recording.missing[Features] == 0


def test_a_model_that_was_made_once_more_counts_once(written):
    path = written([features(1), model(1, 0), features(2), features(3), model(2, 1)])
    written([model(2, 1), features(3, 0.75)], resume=True)
    recording = Recording(path)
    assert [model.version for model in recording.models()] == [1, 2]


def test_a_model_of_features_that_were_replaced_is_none_of_the_run_even_where_it_came_once_more(written):
    """A restarted compressor hears the last model of the trainer, which learned from what it had not stored."""
    path = written([features(1), model(1, 0), features(2), features(3)])
    written([model(2, 2), features(2, 0.75), features(3, 0.75), features(4)], resume=True)
    recording = Recording(path)
    assert [model.version for model in recording.models()] == [1]
    assert recording.counts[Model] == 1


def test_what_is_missing_is_counted_at_the_begin_between_and_at_the_end(written):
    recording = Recording(written([features(3), features(6), track(2), track(9), End(11, "its end")]))
    assert recording.missing == {Features: 2 + 2 + 4, Track: 1 + 6 + 1}
    assert "8 features and 8 tracks missing" in str(recording)


def test_a_full_disk_is_an_error_and_leaves_the_file_whole(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RecordingWriter(tmp_path / "full.rec", run_of(Settings())) as writer:
        size = writer.path.stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, hard))
        try:
            with pytest.raises(RecordingError, match="any more: File too large"):
                writer.write(features(1))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    recording = Recording(writer.path)
    assert (recording.counts[Features], recording.size, recording.torn) == (0, size, 0)


def test_a_file_that_is_there_is_kept(written):
    path = written([track(1)])
    with pytest.raises(RecordingError, match="is there already"):
        written([])
    with pytest.raises(RecordingError, match="other settings"):
        written([], Settings(coreset={"size": 99}), resume=True)
    with (
        RecordingWriter(path, Recording(path).run, resume=True),
        pytest.raises(RecordingError, match="somebody else records"),
    ):
        written([], resume=True)
    assert len(read(path)) == 2


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"something else entirely")
    with pytest.raises(RecordingError, match="is no recording"):
        Recording(tmp_path / "video.mp4")
    with pytest.raises(RecordingError, match="No such file"):
        Recording(tmp_path / "none.rec")
    with pytest.raises(RecordingError, match="give a place that you may write to"):
        RecordingWriter(tmp_path / "none" / "run.rec", run_of(Settings()))
