"""The command line as a whole: imports, suggestions and exit codes; and `catstream settings`."""

import signal

import click
import pytest

from catstream.base.settings import describe
from catstream.cli import COMMANDS, group, load_command


def test_start_server_imports_while_the_command_track_is_imported(monkeypatch):
    calls = []
    monkeypatch.setattr("catstream.processes.start_server.start_server", lambda: calls.append("start_server"))
    monkeypatch.setattr("catstream.cli.load_command", calls.append)
    context = click.Context(group)
    assert group.get_command(context, "track") is group.get_command(context, "status") is None
    assert calls == ["start_server", "track", "status"]


NUMBERS = [
    (name, option.opts[0])
    for name in COMMANDS
    for option in load_command(name).params
    if isinstance(option.type, click.FloatRange)
]


@pytest.mark.parametrize(("name", "option"), NUMBERS)
def test_nan_is_rejected_by_every_number_option(fail, name, option):
    assert f"Invalid value for '{option}': expected a number, got 'nan'" in fail(name, option, "nan")


def test_ctrl_c_ends_a_command_with_status_130(catstream, until, tmp_path):
    process = catstream("demo", "--frames", 100_000, cwd=tmp_path)
    until(lambda: list(tmp_path.glob("demo/*")) or process.poll() is not None)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=500)[1]
    assert process.returncode == 130, errors
    assert errors.strip().splitlines()[-1] == "stopped"
    assert "Traceback" not in errors


def test_settings_in_a_pipe_are_one_line_each(succeed):
    output, _ = succeed("settings")
    lines = [line.split("\t") for line in output.splitlines()]
    assert lines == [[entry.name, str(entry.default), entry.takes, entry.about] for entry in describe().values()]


def test_words_select_settings_by_name_and_description(succeed, fail):
    output, _ = succeed("settings", "coreset", "N IN THE PAPER")
    assert [line.partition("\t")[0] for line in output.splitlines()] == ["coreset.size"]
    assert "no setting has 'nothing-of-this-kind'" in fail("settings", "nothing-of-this-kind")


@pytest.mark.parametrize(
    ("words", "nearest"),
    [(["trak"], "track"), (["set_box"], "set-box"), (["fleet", "staus"], "status"), (["keys", "alow"], "allow")],
)
def test_nearest_command_is_suggested(fail, words, nearest):
    assert fail(*words).endswith(f"Did you mean {nearest!r}?")
    assert "Did you mean" not in fail(*words[:-1], "xyzzy")
