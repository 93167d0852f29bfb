"""Where a page listens, and the token that opens it, as the commands that serve one accept them."""

from __future__ import annotations

import re

import click
import pytest
from click.testing import CliRunner

from catstream.cli.serving import AddressType, with_token


@pytest.mark.parametrize("text", ["", "x", "host:", "8000:host", "70000", "-1"])
def test_a_malformed_address_is_an_error(text):
    with pytest.raises(click.BadParameter, match="for example 8000"):
        AddressType().convert(text, None, None)


@pytest.mark.parametrize("prefix", ["", "view-"])
def test_the_token_of_a_page_is_read_from_an_option_a_variable_or_a_file(prefix, tmp_path):
    file, empty = tmp_path / "token", tmp_path / "empty"
    file.write_text("from-a-file-of-mine\n")
    empty.write_text("\n")

    @click.command()
    @with_token(prefix)
    def command(token):
        click.echo(str(token))

    def says(*words, **variables):
        return CliRunner().invoke(command, list(words), env=variables, standalone_mode=False)

    made = [says().output, says(VIEW_TOKEN="").output]
    assert all(re.fullmatch(r"[0-9a-f]{32}\n", each) for each in made), "a random one"
    assert made[0] != made[1]
    assert says(f"--no-{prefix}token").output == "None\n"
    assert "leave out one of them" in str(says(f"--no-{prefix}token", VIEW_TOKEN="from-a-variable-1").exception)
    assert says(f"--{prefix}token", "given-on-the-line").output == "given-on-the-line\n"
    assert says(VIEW_TOKEN="from-a-variable-1").output == "from-a-variable-1\n"
    assert says(f"--{prefix}token-file", str(file)).output == "from-a-file-of-mine\n"
    assert says(VIEW_TOKEN_FILE=str(file)).output == "from-a-file-of-mine\n"
    assert "cannot be read" in str(says(f"--{prefix}token-file", str(tmp_path)).exception)
    assert "there is no token" in str(says(VIEW_TOKEN_FILE=str(empty)).exception)
