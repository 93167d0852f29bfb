"""Which pipeline `stop`, `set-box`, `pause`, `resume` and `save` command: the one that is named, or the only one."""

import tempfile
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from catstream.cli import group
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


@pytest.mark.parametrize("words", [["stop"], ["pause"], ["resume"], ["set-box", "1,2,3,4"]])
def test_command_prints_the_name_of_the_selected_pipeline(pipeline, words):
    place, heard = pipeline("/films/walk.mp4")
    result = said(*words)
    assert result.exit_code == 0
    assert result.stderr == f"pipeline: /films/walk.mp4 at {place}\n"
    assert result.stdout == f"{words[0]} was done\n"
    assert heard == [words[0]]


def test_one_of_several_pipelines_is_selected_by_its_endpoint(pipeline, tmp_path):
    first, walk = pipeline(str(tmp_path / "walk.mp4"))
    pipeline("rtsp://10.0.0.7/street")
    error = str(said("stop").exception)
    assert error.startswith("2 pipelines are running: select one (--endpoint)")
    assert f"walk.mp4 at {first}" in error
    assert said("stop", "--endpoint", first).exit_code == 0
    assert walk == ["stop"]


def test_empty_endpoint_selects_no_pipeline(pipeline):
    _, heard = pipeline("/films/walk.mp4")
    result = said("stop", "--endpoint", "")
    assert (result.exit_code, heard) == (2, [])
    assert "is empty" in result.stderr
