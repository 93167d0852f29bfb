"""Help teaches, also about settings: what a command does and writes, and an example. And what all commands do alike."""

import signal

import click
import pytest

from catstream.base.settings import describe
from catstream.cli import COMMANDS, group, load_command
from catstream.processes.by_hand import parser
from catstream.processes.start_server import NAMES


@pytest.fixture
def help_of(said):
    """What `catstream COMMAND --help` says."""

    def ask(*words):
        code, output, errors = said(*words, "--help")
        assert (code, errors) == (0, "")
        return " ".join(output.split())

    return ask


def test_help_lists_the_commands_and_shows_a_first_example(help_of):
    text = help_of()
    assert "Track objects in a video stream" in text
    assert all(command in text for command in COMMANDS)
    assert "catstream track walk.mp4 --box 120,80,64,48" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help_text_with_examples(help_of, command):
    text = help_of(command)
    assert text.startswith(f"Usage: catstream {command}")
    assert " EXAMPLES catstream " in text


def test_start_server_imports_while_the_command_track_is_imported(monkeypatch):
    calls = []
    monkeypatch.setattr("catstream.processes.start_server.start_server", lambda: calls.append("start_server"))
    monkeypatch.setattr("catstream.cli.load_command", calls.append)
    context = click.Context(group)
    assert group.get_command(context, "track") is group.get_command(context, "status") is None
    assert calls == ["start_server", "track", "status"]


def test_the_help_of_track_fits_on_a_screen(said):
    _, output, _ = said("track", "--help")
    lines = output.splitlines()
    assert len(lines) <= 50
    assert sum(line.startswith("  -") for line in lines) <= 23  # with --help


NUMBERS = [
    (name, option.opts[0])
    for name in COMMANDS
    for option in load_command(name).params
    if isinstance(option.type, click.FloatRange)
]


@pytest.mark.parametrize(("name", "option"), NUMBERS)
def test_nan_is_within_no_bounds(fail, name, option):
    assert f"Invalid value for '{option}': expected a number, got 'nan'" in fail(name, option, "nan")


@pytest.mark.parametrize("name", NAMES)
def test_every_process_has_a_help_text(name):
    assert parser(name).format_help().startswith(f"usage: services/{name}.py")


def test_ctrl_c_ends_a_command_with_130_and_no_traceback(catstream, until, tmp_path):
    process = catstream("demo", "--frames", 100_000, cwd=tmp_path)
    until(lambda: list(tmp_path.glob("demo/*")) or process.poll() is not None)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=500)[1]
    assert process.returncode == 130, errors
    assert errors.strip().splitlines()[-1] == "stopped"
    assert "Traceback" not in errors


def test_in_a_pipe_each_setting_is_one_whole_line(said):
    code, output, _ = said("settings")
    lines = [line.split("\t") for line in output.splitlines()]
    assert code == 0
    assert lines == [[entry.name, str(entry.default), entry.takes, entry.about] for entry in describe().values()]


def test_words_select_settings_by_name_and_description(said):
    _, output, _ = said("settings", "coreset", "N IN THE PAPER")
    assert [line.partition("\t")[0] for line in output.splitlines()] == ["coreset.size"]
    code, _, errors = said("settings", "nothing-of-this-kind")
    assert (code, "no setting has 'nothing-of-this-kind'" in errors) == (1, True)


@pytest.mark.parametrize(
    ("words", "meant"),
    [(["trak"], "track"), (["set_box"], "set-box"), (["fleet", "staus"], "status"), (["keys", "alow"], "allow")],
)
def test_nearest_command_is_suggested_for_a_mistyped_one(fail, words, meant):
    assert fail(*words).endswith(f"Did you mean {meant!r}?")
    assert "Did you mean" not in fail(*words[:-1], "xyzzy")
