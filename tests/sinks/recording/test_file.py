"""The file of a recording: what was written is read, but for what a crash cut off or a disk damaged."""

from __future__ import annotations

import json
import re
import resource
import subprocess
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from catstream.box import Box
from catstream.errors import RecordingError
from catstream.messages.kinds import End, Features, Health, Model, ObjectFeatures, Run, Track, TrainingRows
from catstream.settings import Settings
from catstream.sinks.recording.container import INDEX_SIZE, MAGIC, Container, entries
from catstream.sinks.recording.file import TOPICS, Recording, RecordingWriter
from catstream.wire.codec import decode, encode, encode_json


def features(seq, value=0.5):
    rows = np.full((1, 3), value, np.float32)
    training = {"appearance": TrainingRows(rows, rows[0, :1], rows[0, :1])}
    return Features(seq, seq - 1, 0.0, {"": ObjectFeatures(None, training)})


def track(seq, name=""):
    return Track(seq, seq - 1, seq / 30, "present", Box(1.0, 2.0, 3.0, 4.0), 0.9, 1, object=name)


def model(version, frame, name=""):
    return Model(version, frame, np.full(3, version, np.float32), 0.5, object=name)


def places(path):
    """Where the messages of a file begin and end."""
    with path.open("rb") as file:
        return [(entry.place, entry.end) for entry in entries(file)]


def read(path):
    return [message for _, message in Recording(path).messages()]


def test_written_messages_are_read_back_with_the_settings(written):
    settings = Settings(coreset={"size": 32}, teaching={"classifier": "one-class"}, run={"endpoint": "somewhere"})
    messages = [track(1), features(1), model(1, 0), Health("trainer", 2.0, {"trained": 1.0}), End(2, "its end")]
    recording = Recording(written(messages, settings))
    run, *others = (message for _, message in recording.messages())
    assert recording.settings == settings.but({"run.endpoint": ""})
    assert run == recording.run
    assert list(map(encode, others)) == list(map(encode, messages))
    assert recording.end == messages[-1]
    assert recording.torn == 0


def test_a_crash_at_any_byte_leaves_all_messages_before_it(written, tmp_path):
    messages = [track(1), features(1), model(1, 0)]
    path = written(messages)
    ends = [end for _, end in places(path)]
    whole, cut = path.read_bytes(), tmp_path / "cut.rec"
    for size in [*range(ends[0], ends[-1]), *range(ends[-1], len(whole), 50)]:
        cut.write_bytes(whole[:size])
        kept = sum(end <= size for end in ends[1:])
        recording = Recording(cut)
        kinds = [type(message) for _, message in recording.messages()]
        assert kinds == [Run, *map(type, messages[:kept])]
        assert recording.torn == max(size - ends[kept] - INDEX_SIZE, 0)
        assert not any(recording.missing.values())
    assert Recording(path).torn == 0


@pytest.mark.parametrize("size", [0, 5, 8, 60, 500, -1])
def test_a_file_that_was_cut_before_the_end_of_its_settings_is_no_recording(written, size):
    path = written([])
    path.write_bytes(path.read_bytes()[: size if size >= 0 else Recording(path).size - 1])
    with pytest.raises(RecordingError):
        Recording(path)


@given(share=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_changed_bit_invalidates_its_own_message_only(tmp_path_factory, share, bit):
    path = tmp_path_factory.mktemp("changed") / "run.rec"
    with RecordingWriter(path, Run.from_settings(Settings().portable())) as writer:
        for seq in range(1, 10):
            writer.write(track(seq))
    content, (run, *chunks) = bytearray(path.read_bytes()), places(path)
    changed = len(MAGIC) + int(share * (len(content) - len(MAGIC) - run[1] + run[0]))
    changed += (run[1] - run[0]) * (changed >= run[0])  # without the settings it is no recording
    content[changed] ^= 1 << bit
    path.write_bytes(content)
    recording = Recording(path)
    # Nothing depends on the times of a chunk, which are in its message too, nor on the index behind it.
    hit = [begin <= changed < end and not begin + 9 <= changed < begin + 25 for begin, end in chunks]
    assert read(path)[1:] == [track(seq) for seq, is_hit in enumerate(hit, 1) if not is_hit]
    if any(hit):
        begin, end = chunks[hit.index(True)]
        size = end - begin + INDEX_SIZE
        assert (recording.damaged, recording.torn) == (size, 0)
        assert f"{size} damaged bytes skipped" in str(recording)


def test_a_hole_costs_the_messages_that_lie_in_it(written):
    path = written([track(seq) for seq in range(1, 10)])
    content, (_, *begins) = bytearray(path.read_bytes()), [place for place, _ in places(path)]
    content[begins[3] + 7 : begins[5] + 7] = bytes(begins[5] - begins[3])
    path.write_bytes(content)
    recording = Recording(path)
    assert [message.seq for message in read(path)[1:]] == [1, 2, 3, 7, 8, 9]
    assert recording.damaged == begins[6] - begins[3]
    assert recording.missing[Track] == 3


def test_another_program_reads_it_by_topic_and_time(written):
    path = written([track(1), features(1), model(1, 0), track(2), Health("trainer", 2.0, {"trained": 1.0}), End(3, "")])
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        names = {number: channel.topic for number, channel in summary.channels.items()}
        counts = {names[number]: count for number, count in summary.statistics.channel_message_counts.items()}
        assert counts == {"run": 1, "tracks": 2, "features": 1, "models": 1, "health": 1, "end": 1}
        assert {schema.name for schema in summary.schemas.values()} == {"features", "models"}
        tracks = [message for _, _, message in reader.iter_messages("tracks")]
        assert [json.loads(message.data) for message in tracks] == [track(seq).to_dict() for seq in (1, 2)]
        assert [message.sequence for message in tracks] == [1, 2]
        (later,) = reader.iter_messages("tracks", starting_after=tracks[0].log_time)
        assert later[2].sequence == 2
        ((_, channel, message),) = reader.iter_messages("features")
        assert channel.message_encoding == "msgpack"
        assert decode(message.data, Features).seq == 1


def test_the_example_of_the_docs_prints_the_boxes(written, monkeypatch, capsys):
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "record.md").read_text()
    (example,) = re.findall(r"```python\n(import json.*?)```", page, re.DOTALL)
    path = written([track(1), track(2)])
    path.rename(path.with_name("walk.mcap"))
    monkeypatch.chdir(path.parent)
    exec(compile(example, "docs/how-to/record.md", "exec"), {})
    assert capsys.readouterr().out == "[1.0, 2.0, 3.0, 4.0]\n" * 2


def test_another_program_reads_it_from_start_to_end(written):
    path = written([features(seq) for seq in range(1, 4)])
    with path.open("rb") as file:
        records = list(StreamReader(file, validate_crcs=True).records)
    assert [record.sequence for record in records if isinstance(record, Message)] == [0, 1, 2, 3]


def test_it_continues_in_a_second_file_after_the_last_whole_message(written):
    path = written([features(1), features(2)])
    path.write_bytes(path.read_bytes()[: Recording(path).size - 7])
    before = path.read_bytes()
    written([features(2), features(3)], resume=True)
    written([End(4, "its end")], resume=True)
    recording = Recording(path)
    assert [file.name for file in recording.files] == ["run.rec", "run-2.rec", "run-3.rec"]
    assert [message.seq for message in recording.features()] == [1, 2, 3]
    assert [type(message) for message in read(path)] == [Run, Features, Features, Features, End]
    assert path.read_bytes() == before
    assert recording.complete is False, "it has no tracks"
    assert "in 3 files" in str(recording)
    with recording.files[1].open("rb") as file:
        assert len(list(make_reader(file, validate_crcs=True).iter_messages())) == 3, "each file is one for others too"


def test_another_recording_whose_name_is_that_of_a_second_file_is_neither_read_nor_replaced(written):
    path = written([features(1)])
    other = path.with_name("run-2.rec")
    with RecordingWriter(other, Recording(path).run) as writer:
        writer.write(features(7))
    path.with_name("run-3.rec").write_text("dear to somebody")
    before = other.read_bytes()
    written([features(2)], resume=True)
    assert [file.name for file in Recording(path).files] == ["run.rec", "run-4.rec"]
    assert [message.seq for message in Recording(path).features()] == [1, 2]
    assert other.read_bytes() == before
    assert [message.seq for message in Recording(other).features()] == [7]


def test_a_second_file_whose_settings_are_damaged_is_read_too(written):
    path = written([features(1)])
    written([features(2)], resume=True)
    second = path.with_name("run-2.rec")
    content = bytearray(second.read_bytes())
    content[places(second)[0][0] + 100] ^= 1
    second.write_bytes(content)
    assert [message.seq for message in Recording(path).features()] == [1, 2]


def test_a_recording_of_many_messages_goes_on_in_further_files(written, monkeypatch):
    monkeypatch.setattr("catstream.sinks.recording.file._MOST_MESSAGES", 4)
    path = written([*(track(seq) for seq in range(1, 10)), End(10, "its end")])
    recording = Recording(path)
    assert len(recording.files) == 3
    assert [message.seq for message in read(path)[1:]] == list(range(1, 11))
    assert (recording.counts[Run], recording.damaged, recording.torn) == (1, 0, 0)


def test_features_that_a_restarted_compressor_receives_again_replace_the_earlier_ones(written):
    path = written([features(1), model(1, 0), features(2), features(3, 0.125), model(2, 2)])
    written([features(3, 0.75), model(2, 2), features(4)], resume=True)
    recording = Recording(path)
    taken = [
        (message.seq, float(message.objects[""].training["appearance"].rows[0, 0])) for message in recording.features()
    ]
    assert taken == [(1, 0.5), (2, 0.5), (3, 0.75), (4, 0.5)]
    assert [model.version for model in recording.models()] == [1, 2]
    assert recording.missing[Features] == 0


def test_the_end_of_a_run_that_was_stopped_is_not_the_end_of_its_continuation(written):
    path = written([features(1), track(1), End(2, "it was stopped")])
    written([features(2), track(2), features(3), track(3)], resume=True)
    recording = Recording(path)
    assert recording.end is None
    assert recording.missing == {Features: 0, Track: 0}
    assert str(recording).endswith("none missing; it ends before the run did")


def test_a_model_that_was_made_once_more_counts_once(written):
    path = written([features(1), model(1, 0), features(2), features(3), model(2, 1)])
    written([model(2, 1), features(3, 0.75)], resume=True)
    recording = Recording(path)
    assert [model.version for model in recording.models()] == [1, 2]


def test_a_model_of_replaced_features_does_not_count_even_if_it_is_received_again(written):
    """A restarted compressor hears the last model of the trainer, which learned from what it had not stored."""
    path = written([features(1), model(1, 0), features(2), features(3)])
    written([model(2, 2), features(2, 0.75), features(3, 0.75), features(4)], resume=True)
    recording = Recording(path)
    assert [model.version for model in recording.models()] == [1]
    assert recording.counts[Model] == 1


def test_models_of_several_objects_in_one_frame_all_count_and_are_replaced_one_by_one(written):
    made = [model(1, 0, "anna"), model(2, 0, "ben"), model(4, 2, "ben"), model(3, 1, "anna")]
    path = written([features(1), *made[:2], features(2), features(3), *made[2:]])
    assert [message.version for message in Recording(path).models()] == [1, 2, 4, 3], "as they were recorded"
    written([features(3, 0.75), model(3, 1, "anna"), model(5, 2, "ben")], resume=True)
    again = Recording(path)
    assert [(message.object, message.version) for message in again.models()] == [
        ("anna", 1), ("ben", 2), ("anna", 3), ("ben", 5),
    ]  # fmt: skip
    assert again.counts[Model] == 4


def test_a_frame_with_a_track_of_any_object_is_not_missing(written):
    said = [track(1, "anna"), track(2, "anna"), track(2, "ben"), track(3, "ben"), track(5, "ben"), End(6, "its end")]
    recording = Recording(written(said))
    assert (recording.counts[Track], recording.frames, recording.missing[Track]) == (5, 4, 1)


def test_a_track_that_a_restarted_detector_repeats_counts_once(written):
    tracks = [track(seq, name) for seq in (1, 2) for name in ("anna", "ben")]
    recording = Recording(written([*tracks, *tracks[2:], track(3, "ben")]))
    assert (recording.counts[Track], recording.frames, recording.missing[Track]) == (5, 3, 0)


def test_tracks_behind_the_end_of_a_detector_that_failed_while_it_repeated_frames_are_not_missing(written):
    recording = Recording(written([features(1), *map(track, (1, 2, 3)), End(2, "it failed", True)]))
    assert recording.missing == {Features: 0, Track: 0}


def test_another_program_tells_the_objects_apart_by_a_field_of_each_message(written):
    path = written([track(1, "anna"), track(1, "ben"), model(1, 0, "anna"), model(2, 0)])
    with path.open("rb") as file:
        said = list(make_reader(file, validate_crcs=True).iter_messages(["tracks", "models"]))
    tracks = [json.loads(message.data) for _, channel, message in said if channel.topic == "tracks"]
    models = [msgpack.unpackb(message.data) for _, channel, message in said if channel.topic == "models"]
    assert [track["object"] for track in tracks] == ["anna", "ben"]
    assert [(about, fields["object"]) for _, _, about, _, fields in models] == [("anna", "anna"), ("", "")]


def with_message(folder, kind, data):
    """A recording with a message of these bytes."""
    kinds, path = list(TOPICS), folder / "run.rec"
    container = Container(path, list(TOPICS.values()), {})
    container.add(kinds.index(Run) + 1, 0, 0, encode_json(Run("", {})))
    container.add(kinds.index(kind) + 1, 1, 0, data)
    container.close()
    return path


@pytest.mark.parametrize(
    ("kind", "data", "told"),
    [
        (Features, msgpack.packb([2, "features", {}]), "expected version 4 of the protocol, got 2"),
        (Model, msgpack.packb([2, "model", {}]), "expected version 4 of the protocol, got 2"),
        (Model, b"of another version", "expected model"),
        (End, b'{"seq": 1, "reason": "\x95"}', "expected end in JSON"),
    ],
    ids=["features of an earlier protocol", "a model of an earlier protocol", "no msgpack", "no UTF-8"],
)
def test_a_message_that_this_version_cannot_read_is_an_error_of_one_line(tmp_path, kind, data, told):
    with pytest.raises(RecordingError, match=f"holds a message at byte .* cannot read: {told}") as raised:
        Recording(with_message(tmp_path, kind, data))
    assert "\n" not in str(raised.value)


def test_missing_messages_are_counted_at_the_start_in_between_and_at_the_end(written):
    recording = Recording(written([features(3), features(6), track(2), track(9), End(11, "its end")]))
    assert recording.missing == {Features: 2 + 2 + 4, Track: 1 + 6 + 1}
    assert "8 features and 8 tracks missing" in str(recording)


def test_a_full_disk_is_an_error_and_leaves_the_file_whole(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RecordingWriter(tmp_path / "full.rec", Run.from_settings(Settings().portable())) as writer:
        size = writer.path.stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, hard))
        try:
            with pytest.raises(RecordingError, match="any more: File too large"):
                writer.write(features(1))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert writer.path.stat().st_size == size
        writer.write(End(2, "its end"))  # by which a reader knows that features are missing
    recording = Recording(writer.path)
    assert (recording.counts[Features], recording.end, recording.torn) == (0, End(2, "its end"), 0)
    assert recording.missing[Features] == 1


def test_an_existing_file_is_not_overwritten(written):
    path = written([track(1)])
    with pytest.raises(RecordingError, match="exists already"):
        written([])
    with pytest.raises(RecordingError, match="other settings"):
        written([], Settings(coreset={"size": 99}), resume=True)
    with (
        RecordingWriter(path, Recording(path).run, resume=True),
        pytest.raises(RecordingError, match="another process records"),
    ):
        written([], resume=True)
    assert len(read(path)) == 2


def test_a_file_that_is_not_a_recording_is_rejected(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"something else entirely")
    with pytest.raises(RecordingError, match="is not a recording"):
        Recording(tmp_path / "video.mp4")
    with pytest.raises(RecordingError, match="No such file"):
        Recording(tmp_path / "none.rec")
    with pytest.raises(RecordingError, match="give a path that you may write to"):
        RecordingWriter(tmp_path / "none" / "run.rec", Run.from_settings(Settings().portable()))


def test_a_recording_on_a_read_only_disk_is_rejected(disk):
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    with pytest.raises(RecordingError, match="Read-only file system"):
        RecordingWriter(disk / "run.mcap", Run.from_settings(Settings().portable()), resume=True)
