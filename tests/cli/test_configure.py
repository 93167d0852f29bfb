"""`catstream settings` in a terminal's place, in a pipe and as JSON."""

import json

import pytest

from catstream.settings import Settings, describe


def test_in_a_pipe_each_setting_is_one_whole_line(said):
    code, output, _ = said("settings")
    lines = [line.split("\t") for line in output.splitlines()]
    assert code == 0
    assert lines == [[name, str(default), takes, meaning] for name, takes, default, meaning in describe()]


def test_words_select_settings_by_name_and_description(said):
    _, output, _ = said("settings", "coreset", "N IN THE PAPER")
    assert [line.partition("\t")[0] for line in output.splitlines()] == ["coreset.size"]
    code, _, errors = said("settings", "nothing-of-this-kind")
    assert (code, "no setting has 'nothing-of-this-kind'" in errors) == (1, True)


@pytest.mark.parametrize("words", [[], ["extent"]])
def test_as_json_a_program_reads_names_and_defaults(said, words):
    _, output, _ = said("settings", "--json", *words)
    read = {each["name"]: each["default"] for each in json.loads(output)}
    assert read.items() <= Settings().values().items()
    assert bool(words) == (len(read) < len(Settings().values()))
