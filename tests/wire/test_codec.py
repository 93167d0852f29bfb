"""Messages to bytes and back."""

import dataclasses
import struct
import tracemalloc
from typing import Any, get_args

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from catstream.base.box import Box
from catstream.base.settings import Settings, describe
from catstream.detection.objects import Detectors
from catstream.errors import ProtocolError
from catstream.features.pyramid import Pyramid
from catstream.video import rendered
from catstream.wire.channels import CHANNELS
from catstream.wire.codec import KINDS, VERSION, decode, encode
from catstream.wire.messages import (
    LARGEST_INITIAL_MODELS,
    Features,
    Health,
    ObjectFeatures,
    Sample,
    Track,
    TrainingRows,
)
from catstream.wire.schema import LONGEST_LIST, LONGEST_TEXT
from tests.wire.examples import example


def array(*shape: int, dtype: str = "<f4") -> np.ndarray:
    return np.linspace(0.1, 0.9, int(np.prod(shape)), dtype=dtype).reshape(shape)


def features(rows: TrainingRows) -> Features:
    return Features(2, 0.08, {"": ObjectFeatures(BOX, {"appearance": rows})})


BOX = Box(4.5, 3.0, 20.0, 10.0)
EXAMPLES = {name: example(kind) for name, kind in KINDS.items()}
ALL = tuple(KINDS.values())


def packed(kind: str, about: object = None, **changes: object) -> bytes:
    """An example as bytes, with some of its fields, or the object of its envelope, replaced on the wire."""
    about = getattr(EXAMPLES[kind], "object", "") if about is None else about
    return msgpack.packb([VERSION, kind, about, "a run", fields_of(kind) | changes])


def fields_of(kind: str) -> dict[str, Any]:
    """The fields of an example, as they travel."""
    *_, sent = msgpack.unpackb(encode(EXAMPLES[kind]))
    return sent


def retrained(**arrays: object) -> bytes:
    """The example of features as bytes, with some of its training rows replaced on the wire."""
    objects = fields_of("features")["objects"]
    objects["anna"]["training"]["appearance"] |= arrays
    return packed("features", objects=objects)


def plain(dtype: str, shape: list[int], data: bytes) -> dict[str, object]:
    return {"dtype": dtype, "shape": shape, "data": data}


@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("kind", ALL)
def test_every_kind_of_message_arrives_as_it_was_sent(kind, full):
    message = example(kind, full)
    arrived = decode(encode(message), kind)
    assert type(arrived) is kind
    np.testing.assert_equal(dataclasses.asdict(arrived), dataclasses.asdict(message))


@pytest.mark.parametrize("kind", ["an array", "bytes"])
def test_arrays_and_bytes_are_copied_once_on_arrival(kind):
    rows = features(TrainingRows.labelled(np.zeros((512, 4096)), 1))
    message = rows if kind == "an array" else dataclasses.replace(EXAMPLES["modelfile"], file=bytes(8 << 20))
    data = encode(message)
    tracemalloc.start()
    try:
        decode(data, type(message))
        assert tracemalloc.get_traced_memory()[1] < 9 << 20
    finally:
        tracemalloc.stop()


def test_arrays_are_sent_row_by_row_in_any_memory_layout():
    rows = TrainingRows(np.asfortranarray(array(3, 5)), array(3), array(3))
    arrived = decode(encode(features(rows)), Features)
    np.testing.assert_array_equal(arrived.objects[""].training["appearance"].rows, array(3, 5))


def test_features_of_the_most_objects_fit_into_their_channel():
    detectors, ((image, box),) = Detectors(Settings()), rendered.render(1, (320, 240))
    pyramid = Pyramid(image)
    _, features = detectors.step(pyramid, results={"": detectors.begin("", pyramid, box)})
    largest = get_args(describe()["run.max_objects"].type)[1].le * len(encode(features)) + LARGEST_INITIAL_MODELS
    assert largest < CHANNELS["all-features"].limit == CHANNELS["features"].limit


def test_nan_arrives_in_an_array_that_allows_it():
    sample = dataclasses.replace(EXAMPLES["sample"], centres=np.full((1, 2), np.nan))
    assert np.isnan(decode(encode(sample), Sample).centres).all()


def test_field_of_a_later_version_is_ignored():
    assert decode(packed("track", colour="red"), Track) == EXAMPLES["track"]


@pytest.mark.parametrize("message", EXAMPLES.values(), ids=EXAMPLES)
def test_message_of_another_kind_is_rejected(message):
    others = [kind for kind in ALL if kind is not type(message)]
    with pytest.raises(ProtocolError, match=f"got '{type(message).__name__.lower()}'"):
        decode(encode(message), *others)


TREES_SENT = fields_of("sample")["trees"]
REJECTED = {
    "an unknown verb": packed("command", verb="format"),
    "a box that the verb does not use": packed("command", verb="stop"),
    "set-box without a box": packed("command", box=None),
    "set-box with a box and several": packed("command", boxes={"anna": [1, 2, 3, 4]}),
    "a dtype that is not allowed": retrained(rows=plain("<f8", [3, 5], bytes(120))),
    "rows in one dimension": retrained(rows=plain("<f4", [15], bytes(60))),
    "a negative side": retrained(rows=plain("<f4", [-3, -5], bytes(60))),
    "less data than its shape": retrained(rows=plain("<f4", [3, 5], bytes(59))),
    "sides whose product is huge": retrained(rows=plain("<f4", [2**32, 2**32], bytes(60))),
    "NaN in an array": retrained(rows=plain("<f4", [3, 5], struct.pack("<f", np.nan) * 15)),
    "NaN as a number": packed("track", score=np.nan),
    "a label below 0": retrained(labels=plain("<f4", [3], struct.pack("<3f", 0, 1, -0.5))),
    "a weight of 0": retrained(weights=plain("<f4", [3], bytes(12))),
    "a tree of another width": packed("sample", trees=TREES_SENT | {"loss": TREES_SENT["object"]}),
    "a sample without the object's tree": packed("sample", trees={"loss": TREES_SENT["loss"]}),
    "a tree of no head": packed("sample", trees=TREES_SENT | {"unknown": TREES_SENT["loss"]}),
    "a name that is no name": packed("features", objects={"an na": {}}),
    "another object in the envelope": packed("track", about="ann"),
    "an object in the envelope, and none in the fields": packed("position", about="anna"),
    "a number as object": packed("track", about=1, object=1),
    "more objects than a map may have": packed("position", versions={f"o{i}": 1 for i in range(257)}),
    "rows of another width in another group": retrained(rows=plain("<f4", [3, 4], bytes(48))),
    "a picture that is no JPEG": packed("preview", jpeg=b"<svg onload=...>"),
    "a picture above its limit": packed("preview", jpeg=b"\xff\xd8\xff" + bytes(1 << 19)),
    "a box without width": packed("track", box=[1.0, 2.0, 0.0, 4.0]),
    "a state that does not exist": packed("track", state="asleep"),
    "a negative frame": packed("track", frame=-1),
    "a frame above 2**53": packed("track", frame=2**53 + 1),
    "a text for a number": packed("track", score="0.5"),
    "a missing field": msgpack.packb([VERSION, "track", "", "", {"frame": 1}]),
    "another version": msgpack.packb([VERSION + 1, "track", "", "", {}]),
    "a kind that does not exist": msgpack.packb([VERSION, "orders", "", "", {}]),
    "no envelope": msgpack.packb({"frame": 1}),
    "half a message": encode(EXAMPLES["features"])[:-20],
    "more than a message": encode(EXAMPLES["track"]) + b"\x00",
    "a map of bytes": b"\x95\x05\xa3end\xa0\xa0\x82\xc4\x05frame\x01\xa6reason\xa1x",
    "a list of four thousand million": b"\x95\x05\xa3end\xa0\xa0\xdd\xff\xff\xff\xff",
    "a map of four thousand million": b"\x95\x05\xa3end\xa0\xa0\xdf\xff\xff\xff\xff",
    "a text of four gigabytes": b"\x95\x05\xdb\xff\xff\xff\xff",
    "a reason longer than a page": packed("end", reason="x" * (LONGEST_TEXT + 1)),
    "an extension type": b"\x95\x05\xa3end\xa0\xa0\xd4\x05\x00",
    "a text for bytes": packed("modelfile", file="YSBmaWxl"),
    "a text for the bytes of an array": retrained(labels=plain("<f4", [3], "AAAA" * 4)),
    "a text that is not UTF-8": b"\x95\x05\xa3end\xa0\xa0\x81\xa6reason\xa1\xff",
    "lists in lists, as fields": b"\x95\x05\xa3end\xa0\xa0" + b"\x91" * 1015 + b"\x90",
    "lists in lists without end": b"\x91" * 100_000,
}


@pytest.mark.parametrize("data", REJECTED.values(), ids=REJECTED)
def test_message_that_violates_its_schema_is_rejected(data):
    with pytest.raises(ProtocolError):
        decode(data, *ALL)


@pytest.mark.parametrize(
    "message",
    [
        features(TrainingRows(array(3, 5, dtype="<f8"), array(3), array(3))),
        features(TrainingRows(array(3, 5), array(4), array(3))),
        dataclasses.replace(EXAMPLES["track"], score=float("nan")),
        dataclasses.replace(EXAMPLES["track"], object="an na"),
        Health("detector", 0.0, trouble="x" * (LONGEST_TEXT + 1)),
    ],
    ids=["dtype", "shape", "NaN", "name", "a text that is too long"],
)
def test_message_that_violates_its_schema_is_not_sent(message):
    with pytest.raises(ProtocolError):
        encode(message)


def many(entry: bytes) -> bytes:
    """As msgpack, 255 lists of 255 lists of eight entries: an object each, if they are made."""
    entry = b"\x98" + entry * 8
    for _ in range(2):
        entry = b"\xdc\x00\xff" + entry * 255
    return entry


BOMBS = {"lists": b"\x90", "maps": b"\x80", "lists of maps": b"\x91\x81\xa1x\x80", "texts": b"\xa2xy"}


@pytest.mark.parametrize("place", ["colour", "weights", "version"])
@pytest.mark.parametrize("bomb", BOMBS.values(), ids=BOMBS)
def test_too_many_entries_take_little_memory_in_any_field(bomb, place):
    data = b"\x95\x05\xa5model\xa0\xa0\x81" + msgpack.packb(place) + many(bomb)
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError, match="entries"):
            decode(data, *ALL)
        assert tracemalloc.get_traced_memory()[1] < 32 << 20
    finally:
        tracemalloc.stop()


def test_message_with_the_most_entries_arrives():
    names = [f"o{i}" for i in range(LONGEST_LIST)]
    health = Health("detector", 0.0, objects={name: dict.fromkeys(names, 1.5) for name in names})
    assert decode(encode(health), Health) == health


SHAPES = st.lists(st.integers(-2, 2**64 - 1) | st.integers(0, 3), max_size=3)
PLAIN_ARRAYS = st.builds(plain, st.sampled_from(["<f4", "<f8", "|O", ">f4", ""]), SHAPES, st.binary(max_size=32))
NUMBERS = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats()
VALUES = st.recursive(
    NUMBERS | st.text(max_size=8) | st.binary(max_size=8) | PLAIN_ARRAYS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=300)
@given(st.sampled_from(ALL), st.booleans(), st.data())
def test_any_value_in_any_field_arrives_whole_or_is_rejected(kind, full, data):
    version, name, about, run, sent = msgpack.unpackb(encode(example(kind, full)))
    place = sent
    while isinstance(inner := place[key := data.draw(st.sampled_from(sorted(place)))], dict) and inner:
        if data.draw(st.booleans()):
            break
        place = inner
    place[key] = data.draw(VALUES)
    about, run = data.draw(st.just(about) | VALUES), data.draw(st.just(run) | VALUES)
    try:
        message = decode(msgpack.packb([version, name, about, run, sent]), *ALL)
    except ProtocolError:
        return
    encode(message)
