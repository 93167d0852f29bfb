"""docs/protocol.md describes every channel and field, and its example program works."""

import re
import select
import subprocess
import sys
from pathlib import Path

import msgpack
import pytest

from catstream.wire import codec
from catstream.wire.channels import CHANNELS, REGISTRY, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.messages import End, Question, Track
from catstream.wire.newest import Publisher
from catstream.wire.schema import LONGEST_LIST, LONGEST_TEXT
from tests.wire.examples import present, track

DOCS = Path(__file__).parents[2] / "docs"
sys.path.append(str(DOCS))

import fields  # noqa: E402

PAGE = fields.PAGE.read_text(encoding="utf-8")
PROGRAM = re.search(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)[1]


@pytest.mark.parametrize("channel", [*CHANNELS.values(), REGISTRY], ids=lambda channel: channel.name)
def test_every_channel_has_its_row(channel):
    kinds = ", ".join(f"`{kind.__name__.lower()}`" for kind in channel.messages)
    ports = ", ".join(f"+{channel.port + offset}" for offset in range(len(channel.senders)))
    cells = (
        f"`{channel.name}`", kinds, ", ".join(channel.senders), channel.receiver or "anyone", channel.keeps, ports,
        str(channel.megabytes), channel.role,
    )  # fmt: skip
    assert f"| {' | '.join(cells)} |" in PAGE, "docs/protocol.md, table of channels"


def test_tables_of_fields_and_trees_agree_with_the_schemas():
    assert fields.filled(PAGE) == PAGE, "docs/protocol.md is not the schema: run `make protocol`"


def test_limits_and_bytes_agree_with_the_codec():
    assert f"Text is at most {LONGEST_TEXT} characters, a list or map at most {LONGEST_LIST} entries" in PAGE
    assert f"The version is {codec.VERSION}." in PAGE
    example = re.search(r"^```\n((?:[0-9a-f]{2}[ \n])+)```", PAGE, re.MULTILINE)[1]
    assert bytes.fromhex(example) == codec.encode(Question("7", "cam1"))
    assert f"`{codec.opening(End).hex(' ')}` for `end`" in PAGE
    assert f"`{codec.opening(Track, 'anna').hex(' ')}` for" in PAGE
    (expression,) = re.findall(r"`(msgpack\.packb.*?)`", PAGE)
    assert eval(expression, {"msgpack": msgpack, "name": "a" * 40}) == codec.opening(Track, "a" * 40)


def test_subscriber_of_the_page_receives_every_track(endpoint, until):
    assert Endpoint.parse("tcp://127.0.0.1:5700").address(TRACKS) in PROGRAM
    reading = [sys.executable, "-c", PROGRAM, endpoint.address(TRACKS)]
    with Publisher(TRACKS, endpoint) as tracks, subprocess.Popen(reading, stdout=subprocess.PIPE, text=True) as reader:
        until(lambda: select.select([reader.stdout], [], [], 0.05)[0], lambda: tracks.send(track(1)))
        for seq in range(2, 20):
            tracks.send(present(seq, "anna"))
        tracks.send(End(19, "the source has ended"))
        lines = reader.communicate(timeout=500)[0].splitlines()
    assert reader.returncode == 0
    shown = [line for line in lines if "present" in line]
    assert shown == [f"{frame} anna present [1.0, 2.0, 3.0, 4.0] 0.9" for frame in range(1, 19)]
