"""docs/protocol.md says what the wire does: a channel or a field that it leaves out fails here."""

from __future__ import annotations

import dataclasses
import re
import select
import subprocess
import sys
from pathlib import Path

import pytest

from catstream.box import Box
from catstream.messages import DetectorState, End, Motion, Stored, Summary, Track
from catstream.wire import codec
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.sockets import Publisher

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
MESSAGES = [*codec.KINDS.values(), DetectorState, Summary, Motion]


def block(language):
    """The first code block of a language."""
    return re.search(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)[1]


def fields(name):
    """Type of each field in the table of a message."""
    section = re.search(rf"^### `{name}`\n(.*?)(?=^##|\Z)", PAGE, re.DOTALL | re.MULTILINE)
    assert section, f"docs/protocol.md has no section on {name}"
    return dict(re.findall(r"^\| `(\w+)` \| ([^|]+?) \|", section[1], re.MULTILINE))


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=CHANNELS)
def test_every_channel_has_its_row(channel):
    kinds = ", ".join(f"`{kind.__name__.lower()}`" for kind in channel.messages)
    ports = ", ".join(f"+{channel.port + offset}" for offset in range(len(channel.senders)))
    cells = (
        f"`{channel.name}`", kinds, ", ".join(channel.senders), channel.receiver or "anyone", channel.keeps, ports,
        f"{channel.megabytes} MiB", channel.role,
    )  # fmt: skip
    assert f"| {' | '.join(cells)} |" in PAGE, "docs/protocol.md, table of channels"


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__.lower())
def test_every_field_has_its_row(kind):
    names = [field.name for field in dataclasses.fields(kind)]
    assert list(fields(kind.__name__.lower())) == names, "docs/protocol.md, in the order of catstream.messages"


@pytest.mark.parametrize("kind", codec._ARRAYS, ids=lambda kind: kind.__name__.lower())
def test_every_array_has_its_type_and_shape(kind):
    types = fields(kind.__name__.lower())
    for name, (dtype, shape) in codec._ARRAYS[kind].items():
        assert types[name].removesuffix(" or nil") == f"{dtype.name} ({', '.join(map(str, shape))})"


def test_the_limits_are_those_of_the_codec():
    text = f"Text is at most {codec._LONGEST_TEXT} bytes, a list or map at most {codec._LONGEST_LIST} entries"
    assert text in PAGE
    assert f"The version is {codec.VERSION}." in PAGE
    assert codec._LARGEST_INTEGER == 2**53


def test_the_example_in_bytes_is_what_travels():
    example = re.search(r"^```\n((?:[0-9a-f]{2}[ \n])+)```", PAGE, re.MULTILINE)[1]
    assert bytes.fromhex(example) == codec.encode(Stored(5, 7, 2))
    assert f"`{codec.opening(End).hex(' ')}` for `end`" in PAGE


@pytest.mark.parametrize("text", ["run", "tcp://127.0.0.1:5700"])
def test_the_address_of_the_example_is_that_of_the_channel(text):
    assert Endpoint.parse(text).address(CHANNELS["tracks"]) in block("python")


def test_the_subscriber_of_the_page_hears_every_track(endpoint, until):
    address = endpoint.address(CHANNELS["tracks"])
    with (
        Publisher("tracks", endpoint) as tracks,
        subprocess.Popen([sys.executable, "-c", block("python"), address], stdout=subprocess.PIPE, text=True) as reader,
    ):
        hello = Track(1, 0, 0.0, "absent", None, 0.0, 0)
        until(lambda: heard(reader.stdout), lambda: tracks.send(hello))
        for seq in range(2, 20):
            tracks.send(Track(seq, seq - 1, 0.0, "present", Box(1.0, 2.0, 3.0, 4.0), 0.5, 1))
        tracks.send(End(20, "the source came to its end"))
        lines = reader.communicate(timeout=60)[0].splitlines()
    assert reader.returncode == 0
    assert [line for line in lines if "present" in line] == [
        f"{frame} present [1.0, 2.0, 3.0, 4.0] 0.5" for frame in range(1, 19)
    ]


def heard(stream):
    """Whether there is something to read."""
    return select.select([stream], [], [], 0.05)[0]
