"""The commands of a fleet."""

from __future__ import annotations

from collections import Counter

import click
import pytest

from catstream.cli.fleet import fleet


@pytest.mark.parametrize("name", fleet.list_commands(click.Context(fleet)))
def test_no_two_parameters_of_a_command_have_the_same_name(name):
    command = fleet.get_command(click.Context(fleet), name)
    assert set(Counter(parameter.name for parameter in command.params).values()) == {1}
