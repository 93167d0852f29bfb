"""The file of a fleet: its streams, their changes, and one line for each error."""

from dataclasses import replace
from pathlib import Path

import pytest

from catstream.base.box import Box
from catstream.errors import FleetError
from catstream.fleet.spec import FleetSpec, StreamSpec, from_json, to_json
from catstream.video.live_demo import first_box

WHOLE = """
name = "site"
store = "state"
every = 2

[streams.cam-7]
source = "rtsp://me:secret@camera/1"
box = [120, 80, 64, 48]
settings = { coreset = { size = 128 }, "run.seed" = 3 }
cores = 0.5
labels = { site = "north" }

[streams."cam.8"]
source = "walk.mp4"
boxes = { anna = [1, 2, 30, 40] }
models = { ben = "ben.safetensors" }

[streams.cam_9]
source = "0"
"""


@pytest.fixture
def load(tmp_path):
    def load(text):
        (tmp_path / "site.toml").write_text(text, encoding="utf-8")
        return FleetSpec.load(tmp_path / "site.toml")

    return load


def test_paths_are_relative_to_the_file_and_passwords_are_redacted(load, tmp_path):
    fleet = load(WHOLE)
    assert "me:secret" not in repr(fleet)
    assert (fleet.name, fleet.store, fleet.every) == ("site", str(tmp_path / "state"), 2.0)
    first, second, third = fleet.streams.values()
    assert (first.source, first.boxes) == ("rtsp://me:secret@camera/1", {"": Box(120, 80, 64, 48)})
    assert (first.settings, first.cores) == ({"coreset.size": 128, "run.seed": 3}, 0.5)
    assert (second.source, second.boxes) == (str(tmp_path / "walk.mp4"), {"anna": Box(1, 2, 30, 40)})
    assert second.models == {"ben": tmp_path / "ben.safetensors"}
    assert third == StreamSpec("cam_9", "0")


def test_default_destinations_contain_the_name_of_the_stream(load, tmp_path):
    fleet = load("""
        [defaults]
        write = ["tracks/{stream}.ndjson", "http://127.0.0.1/hook?camera={stream}"]
        when = "lost=10,entered"
        zone = { door = "300,80 420,80 420,400" }
        [streams.gate]
        source = "0"
        [streams.yard]
        source = "1"
        write = ["mqtt://127.0.0.1/{stream}"]
        when = "lost=5,entered"
    """)
    gate, yard = fleet.streams.values()
    assert gate.write == (str(tmp_path / "tracks/gate.ndjson"), "http://127.0.0.1/hook?camera=gate")
    assert gate.options.when == {"lost": 10.0, "entered": 0.0}
    assert gate.options.zone == yard.options.zone == {"door": ((300, 80), (420, 80), (420, 400))}
    assert (yard.write, yard.options.when["lost"]) == (("mqtt://127.0.0.1/yard",), 5.0)
    assert from_json(to_json(fleet)) == fleet


@pytest.mark.parametrize("place", ["tracks.ndjson", "mqtt://me:secret@127.0.0.1/yard"])
def test_one_destination_for_two_streams_is_an_error(load, place):
    with pytest.raises(FleetError, match=r"the streams a and b write to .*: put \{stream\} into write$") as caught:
        load(f'[defaults]\nwrite = ["{place}"]\n[streams.a]\nsource = "0"\n[streams.b]\nsource = "1"')
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "restarts"),
    [
        ({"source": "1"}, True),
        ({"boxes": {"": Box(1, 2, 30, 41)}}, True),
        ({"boxes": {}, "models": {"": Path("/a")}}, True),
        ({"settings": {"coreset.size": 128}}, True),
        ({"write": ("/a.csv",)}, True),
        ({"settings": {"run.lag_frames": 25}}, False),
        ({"boxes": {"": Box(1.0, 2.0, 30.0, 40.0)}}, False),
        ({"cores": 2.0}, False),
        ({"labels": {"site": "north"}}, False),
    ],
)
def test_digest_changes_if_the_stream_must_restart(change, restarts):
    stream = StreamSpec("cam-7", "0", {"": Box(1, 2, 30, 40)})
    changed = replace(stream, **change)
    assert (changed.digest != stream.digest) is restarts
    assert (changed.order != stream.order) is (restarts or "cores" in change or "labels" in change)


@pytest.mark.parametrize(
    ("lines", "error"),
    [
        ('[streams.cam-7]\nsource="0"\n[streams.cam-7]\nsource="1"', "this is not TOML: Cannot declare ('streams', "),
        ("", "missing streams: add a table for each, for example [streams.cam-1]"),
        ("[stream.cam-1]\nsource='0'", "unknown key 'stream', did you mean 'streams'?"),
        ("[streams]\ncam-7 = 3", "the stream cam-7: expected a table with a source, got 3: write [streams.cam-7]"),
        ('[streams."cam 7"]\nsource="0"', "'cam 7' is not a valid name of a stream: expected 1 to 64 letters"),
    ],
)
def test_error_of_the_file_is_one_line(load, lines, error, tmp_path):
    with pytest.raises(FleetError) as caught:
        load(lines)
    assert str(caught.value).startswith(f"{tmp_path / 'site.toml'}: {error}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("", "missing source: add one as for `catstream track`, for example source ="),
        ("sorce = '0'", "unknown key 'sorce', did you mean 'source'? expected source, box"),
        ("source = '0'\nbox = [1, 2, 3]", "a box is four numbers x,y,w,h in pixels, got [1, 2, 3]"),
        ("source = '0'\nbox = [1, 2, 30, 0]", "the box of the object without a name: a box needs a width and a height"),
        ("source = '0'\nbox = [1, 2, 3, 4]\nboxes = {}", "box and boxes are mutually exclusive: write all"),
        ("source = '0'\ncores = 0", "cores must be a number above 0, got"),
        ("source = '0'\nwrite = 'a.csv'", "write must be destinations, for example ["),
        ("source = '0'\nwrite = ['-']", "write: a fleet has no standard output: pass a file or an address"),
    ],
)
def test_error_of_a_stream_names_it_and_is_one_line(load, line, error):
    with pytest.raises(FleetError) as caught:
        load(f"[streams.good]\nsource = '0'\n[streams.cam-7]\n{line}")
    assert f"site.toml: the stream cam-7: {error}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_changes_have_a_line_for_each_stream():
    old = FleetSpec("site", streams={name: StreamSpec(name, "0") for name in "abc"})
    streams = {"b": StreamSpec("b", "1"), "c": old.streams["c"], "d": StreamSpec("d", "0", cores=2.0)}
    assert old.changes(replace(old, every=1.0, streams=streams), (), are_running=True) == [
        "a: is removed",
        "b: starts again with its changes",
        "c: is unchanged",
        "d: is added",
        "every changes at the next start, after catstream fleet down",
    ]


def test_damaged_stored_streams_are_an_error():
    for data in (b"", b"{}", b'{"name": "a", "every": -1}'):
        with pytest.raises(FleetError, match="are damaged: apply the fleet file again"):
            from_json(data)


def test_example_and_files_in_the_docs_are_valid(load):
    root = Path(__file__).parents[2]
    fleet = FleetSpec.load(root / "examples" / "fleet.toml")
    assert len(fleet.streams) == 6
    assert all([*stream.boxes.values()] == [first_box(stream.source)] for stream in fleet.streams.values())
    page = (root / "docs" / "how-to" / "fleet.md").read_text(encoding="utf-8")
    six, whole = (part.partition("```")[0] for part in page.split("```toml\n")[1:])
    assert load(six).streams["gate"].options.picture
    assert load(whole).streams["cam-7"].labels == {"site": "north"}
