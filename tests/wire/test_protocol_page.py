"""docs/protocol.md says what the wire does: a channel or a field that it leaves out fails here.

Run as a program, it writes the fields of the messages and the table of the heads: `make protocol`.
"""

import inspect
import re
import select
import subprocess
import sys
from pathlib import Path
from textwrap import fill
from typing import Literal, get_args, get_origin

import msgpack
import pytest

from catstream.base.box import Box, Window
from catstream.messages.heads import TREES
from catstream.messages.kinds import (
    End,
    Motion,
    ObjectFeatures,
    Position,
    Question,
    StreamStatus,
    Summary,
    Track,
    Tracks,
    TrainingRows,
)
from catstream.messages.schema import LARGEST_INTEGER, LONGEST_LIST, LONGEST_TEXT, fields
from catstream.wire import codec
from catstream.wire.channels import CHANNELS, REGISTRY, TRACKS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher
from tests.wire.examples import track

PATH = Path(__file__).parents[2] / "docs" / "protocol.md"
PAGE = PATH.read_text()
PARTS = [Motion, ObjectFeatures, StreamStatus, Summary, TrainingRows]
INTERNAL = {Position, Tracks}  # between the processes of a pipeline: no subscriber sees them
MESSAGES = [*(kind for kind in codec.KINDS.values() if kind not in INTERNAL), *PARTS]
PLAIN = {int: "integer", float: "number", str: "text", bool: "boolean", Box: "box", Window: "window"}


def block(language):
    """The first code block of a language."""
    return re.search(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)[1]


def listed(kind):
    """The list of the fields of a message: types and limits from its schema, meanings from its docstring."""
    parameters = r"^(\w+)(?: : .*\n +|  +)(\S.*(?:\n +\S.*)*)"
    meanings = dict(re.findall(parameters, inspect.cleandoc(kind.__doc__), re.MULTILINE))
    rows = []
    for field in fields(kind):
        meaning = re.sub(r"\s+", " ", meanings[field.name]).replace("None", "nil").rstrip(".")
        kind_and_limits = "" if meaning == "name of the object" else f" ({described(field)})"
        row = f"`{field.name}`{kind_and_limits}: {meaning[0].lower()}{meaning[1:]}"
        rows.append(fill(row, 128, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False) + "\n")
    return "".join(rows)


def described(field):
    """The type of a field and its limits, in words."""
    return kind_of(field) + (" or nil" if field.optional else "")


def kind_of(field):
    if field.values is not None:
        keys = "object" if field.keys.is_name else names_of(field.named)
        kind, _, inner = kind_of(field.values).partition(" by ")
        return f"{kind} by {keys}" + (f" and {inner}" if inner else "")
    if field.is_name:
        return "name of an object"
    if field.is_message:
        return f"`{field.type.__name__.lower()}`" if field.type in MESSAGES else "map"
    if array := field.array:
        nan = ", may be NaN" if array.may_be_nan else ""
        return f"{array.dtype} ({', '.join(map(str, array.shape))}){array.range()}{nan}"
    limits = field.meta
    if get_origin(field.type) is Literal:
        return f"text: {', '.join(f'`{value}`' for value in get_args(field.type))}"
    if get_origin(field.type) is tuple:
        return "array of integers"
    if field.type is bytes:
        return f"bytes, at most {limits.max_length}"
    least = f", at least {limits.ge}" if field.type is int and limits is not None and limits.ge else ""
    return PLAIN[field.type] + least


def names_of(named):
    if named is None:
        return "name"
    return ", ".join(f"`{name}`" + (" (always)" if name in named.required else "") for name in named.columns)


def used(tree):
    return ", ".join(f"`heads.{head.name}`" for head in tree.heads if not head.adds_to_score) or "score"


def heads_table():
    rows = [
        f"| `{name}` | `{tree.group}` | {'all' if tree.label is None else f'label {tree.label:g}'} | "
        f"{f'd + {tree.more_columns}' if tree.more_columns else 'd'} | {used(tree)} |\n"
        for name, tree in TREES.items()
    ]
    head = "| tree | group of training rows | rows | columns | used for |\n| --- | --- | --- | --- | --- |\n"
    return head + "".join(rows)


def section(kind):
    """Where the page has the fields of a message."""
    name = kind.__name__.lower()
    found = re.compile(rf"(^### `{name}`\n(?:(?!^###? ).*\n)*?)((?:^(?:- |  )\S.*\n)+)", re.MULTILINE)
    assert found.search(PAGE), f"docs/protocol.md has no list of fields in a section on {name}"
    return found


@pytest.mark.parametrize("channel", [*CHANNELS.values(), REGISTRY], ids=lambda channel: channel.name)
def test_every_channel_has_its_row(channel):
    kinds = ", ".join(f"`{kind.__name__.lower()}`" for kind in channel.messages)
    ports = ", ".join(f"+{channel.port + offset}" for offset in range(len(channel.senders)))
    cells = (
        f"`{channel.name}`", kinds, ", ".join(channel.senders), channel.receiver or "anyone", channel.keeps, ports,
        str(channel.megabytes), channel.role,
    )  # fmt: skip
    assert f"| {' | '.join(cells)} |" in PAGE, "docs/protocol.md, table of channels"


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__.lower())
def test_the_fields_of_a_message_agree_with_its_schema(kind):
    assert section(kind).search(PAGE)[2] == listed(kind), "docs/protocol.md is not the schema: run `make protocol`"


def test_the_table_of_heads_is_that_of_the_library():
    assert heads_table() in PAGE, "docs/protocol.md is not the table of trees: run `make protocol`"


def test_the_limits_are_those_of_the_codec():
    text = f"Text is at most {LONGEST_TEXT} characters, a list or map at most {LONGEST_LIST} entries"
    assert text in PAGE
    assert f"The version is {codec.VERSION}." in PAGE
    assert LARGEST_INTEGER == 2**53


def test_the_example_in_bytes_agrees_with_the_encoded_message():
    example = re.search(r"^```\n((?:[0-9a-f]{2}[ \n])+)```", PAGE, re.MULTILINE)[1]
    assert bytes.fromhex(example) == codec.encode(Question("7", "cam1"))
    assert f"`{codec.opening(End).hex(' ')}` for `end`" in PAGE
    assert f"`{codec.opening(Track, 'anna').hex(' ')}` for" in PAGE


@pytest.mark.parametrize("text", ["run", "tcp://127.0.0.1:5700"])
def test_the_address_of_the_example_is_that_of_the_channel(text):
    assert Endpoint.parse(text).address(CHANNELS["tracks"]) in block("python")


def test_the_topic_of_one_object_in_the_page_is_that_of_its_tracks():
    (expression,) = re.findall(r"`(msgpack\.packb.*?)`", PAGE)
    for name in ("", "anna", "a" * 40):
        assert eval(expression, {"msgpack": msgpack, "name": name}) == codec.opening(Track, name)


def test_the_subscriber_of_the_page_receives_every_track(endpoint, until):
    address = endpoint.address(CHANNELS["tracks"])
    with (
        Publisher(TRACKS, endpoint) as tracks,
        subprocess.Popen([sys.executable, "-c", block("python"), address], stdout=subprocess.PIPE, text=True) as reader,
    ):
        until(lambda: select.select([reader.stdout], [], [], 0.05)[0], lambda: tracks.send(track(1)))
        for seq in range(2, 20):
            for name in ("anna", "ben"):
                tracks.send(Track(seq - 1, 0.0, "present", Box(1.0, 2.0, 3.0, 4.0), 0.5, 1, object=name))
        tracks.send(End(19, "the source has ended"))
        lines = reader.communicate(timeout=150)[0].splitlines()
    assert reader.returncode == 0
    assert [line for line in lines if "present" in line] == [
        f"{frame} {name} present [1.0, 2.0, 3.0, 4.0] 0.5" for frame in range(1, 19) for name in ("anna", "ben")
    ]


if __name__ == "__main__":
    for kind in MESSAGES:
        PAGE = section(kind).sub(lambda found, kind=kind: found[1] + listed(kind), PAGE)
    PATH.write_text(re.sub(r"^\| tree \|.*\n(\|.*\n)+", lambda _: heads_table(), PAGE, flags=re.MULTILINE))
