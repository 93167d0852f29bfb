"""Which pipeline `stop`, `set-box`, `pause`, `resume` and `save` command: the one that is named, or the only one."""

import tempfile
from contextlib import ExitStack

import pytest
from click.testing import CliRunner, _NamedTextIOWrapper

from catstream.cli import group
from catstream.messages.kinds import FleetStatus, StreamStatus
from catstream.wire.discovery import private_folder, reserve_endpoint


@pytest.fixture
def pipeline(folder, commanded, monkeypatch):
    """Starts a pipeline as far as commands can tell; gives its endpoint and the list of the commands that came.

    No pipelines but those of the test are found.
    """
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    with ExitStack() as stack:

        def start(source):
            own = stack.enter_context(private_folder())
            place = stack.enter_context(reserve_endpoint("", own, source=source))
            return place, stack.enter_context(commanded(place))

        yield start


def said(*words, **options):
    return CliRunner().invoke(group, [*map(str, words)], prog_name="catstream", **options)


def at_a_terminal(monkeypatch):
    monkeypatch.setattr(_NamedTextIOWrapper, "isatty", lambda _: True, raising=False)


@pytest.mark.parametrize("words", [["stop"], ["pause"], ["resume"], ["set-box", "1,2,3,4"]])
def test_a_script_gets_the_name_of_the_selected_pipeline(pipeline, words):
    place, heard = pipeline("/films/walk.mp4")
    result = said(*words)
    assert result.exit_code == 0
    assert result.stderr == f"pipeline: /films/walk.mp4 at {place}\n"
    assert result.stdout == f"{words[0]} was done\n"
    assert heard == [words[0]]


def test_at_a_terminal_a_command_to_an_unnamed_pipeline_needs_confirmation(pipeline, monkeypatch):
    place, heard = pipeline("/films/walk.mp4")
    at_a_terminal(monkeypatch)
    refused = said("stop", input="n\n")
    assert (refused.exit_code, heard) == (1, [])
    assert f"/films/walk.mp4 at {place}. Is this the right one?" in refused.stderr
    assert "no command was sent" in str(refused.exception)
    assert said("stop", input="\n").exit_code == 0
    for named in (["--yes"], ["--endpoint", place], ["--source", "walk.mp4"]):
        assert "Is this the right one" not in said("stop", *named, input="n\n").stderr
    assert heard == ["stop"] * 4


def test_a_pipeline_can_be_selected_by_its_source(pipeline, tmp_path, monkeypatch):
    first, walk = pipeline(str(tmp_path / "walk.mp4"))
    _, street = pipeline("rtsp://10.0.0.7/street")
    error = str(said("stop").exception)
    assert error.startswith("2 pipelines are running: ")
    assert "walk.mp4 at /" in error, "it says what each follows"
    assert "(--endpoint)" in error
    monkeypatch.chdir(tmp_path)
    for name in ("walk.mp4", tmp_path / "walk.mp4", "./walk.mp4"):
        assert said("pause", "--source", name).exit_code == 0
    assert said("stop", "--source", "rtsp://10.0.0.7/street").exit_code == 0
    assert (walk, street) == (["pause"] * 3, ["stop"])
    assert "no pipeline of yours tracks 'other.mp4'" in str(said("stop", "--source", "other.mp4").exception)
    assert said("stop", "--source", "walk.mp4", "--endpoint", tmp_path).exit_code == 2
    status = said("status", "--source", "walk.mp4", "--wait", "0")
    assert f"no health report at {first} " in status.stderr


@pytest.mark.parametrize("option", ["--endpoint", "--stream", "--source"])
def test_an_option_that_is_empty_selects_no_pipeline(pipeline, option):
    _, heard = pipeline("/films/walk.mp4")
    result = said("stop", option, "")
    assert (result.exit_code, heard) == (2, [])
    assert "is empty" in result.stderr


def test_a_stream_of_a_fleet_can_be_selected_by_its_name(pipeline, managing):
    place, heard = pipeline("/films/walk.mp4")
    pipeline("/films/other.mp4")
    stream = StreamStatus("cam-7", "running", source="/films/walk.mp4", endpoint=str(place), token=1)
    with managing(lambda: FleetStatus("site", 0.0, {"cam-7": stream})):
        for words in (["--stream", "cam-7"], ["--stream", "cam-7", "--fleet", "site"]):
            result = said("pause", *words)
            assert (result.exit_code, result.stderr) == (0, f"pipeline: /films/walk.mp4 at {place}\n")
        assert said("resume", "--endpoint", "fleet://site/cam-7").exit_code == 0
        assert heard == ["pause", "pause", "resume"]
        assert "no stream 'cam-8': its streams are cam-7" in str(said("stop", "--stream", "cam-8").exception)


def test_the_status_of_a_stream_that_does_not_run_says_why(managing):
    streams = {"a": StreamStatus("a", "failed", trouble="there is no video"), "b": StreamStatus("b", "ended")}
    with managing(lambda: FleetStatus("site", 0.0, streams)):
        for name, why in {
            "a": "not running (state: failed, there is no video)",
            "b": "not running (state: ended",
        }.items():
            assert why in str(said("status", "--stream", name, "--wait", 0.1).exception)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--fleet", "site"], "--fleet requires --stream NAME"),
        (["--stream", "cam-7", "--endpoint", "run"], "mutually exclusive"),
        (["--stream", "cam-7", "--source", "walk.mp4"], "--source is mutually exclusive with"),
    ],
)
def test_a_pipeline_is_selected_in_one_way(words, reason):
    result = said("stop", *words)
    assert result.exit_code == 2
    assert reason in result.stderr
