"""Addresses of destinations and their options: an invalid value is an error before the run."""

from pathlib import Path

import pytest

from catstream.errors import SettingsError, VideoError
from catstream.output.destinations import SinkOptions, check_sink
from catstream.output.options import parse
from catstream.wire.channels import HEALTH
from catstream.wire.messages import Health
from catstream.wire.newest import Publisher

DOOR, TRIANGLE = {"door": "10,10 90,10 90,90"}, ((10.0, 10.0), (90.0, 10.0), (90.0, 90.0))
YARD, HOOK = "mqtt://127.0.0.1:9/yard", "http://127.0.0.1:9/hook"


def test_file_and_command_line_give_the_same_options():
    given = {"zone": DOOR, "when": "lost=10,entered", "picture": True, "secret_file": "key"}
    expected = SinkOptions({"door": TRIANGLE}, {"lost": 10.0, "entered": 0.0}, 5.0, True, Path("key"), 0.5)
    places = [YARD, HOOK, "events/"]
    assert parse(given | {"rate": 5.0, "megabytes": 0.5}, places) == expected
    assert parse(given | {"rate": "5", "megabytes": "0.5"}, places) == expected
    assert parse({}, ["t.csv"]) == SinkOptions()


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ({"zone": {"door": "1,2 3,four 5,6"}}, "zone: expected the corners of door as X,Y X,Y X,Y ..., got"),
        ({"zone": {"door": ""}}, "zone: zone door: a polygon has at least 3 corners, got 0"),
        ({"zone": {"it's": "1,2 9,4 5,9"}}, "zone: zone: .* is not a name"),
        ({"rotate": "1 week"}, "rotate: expected a time or a size such as 12h, 1d, 500MB or 2GB, got '1 week'"),
        ({"when": "gone"}, "when: expected some of found, lost, returned"),
        ({"when": "found=3"}, "when: expected some of found, lost, returned"),
        ({"when": "lost=soon"}, "when: expected 0 to 86400 seconds, as in lost=10, got 'lost=soon'"),
        ({"when": "lost=nan"}, "when: expected 0 to 86400 seconds"),
        ({"rate": "0"}, "rate: must be a number above 0 and at most 1000, got '0'"),
        ({"megabytes": "none"}, "megabytes: must be a number above 0"),
        ({"when": "entered"}, "when entered has no effect without a zone: add zone"),
    ],
)
def test_invalid_value_is_an_error(values, error):
    with pytest.raises(SettingsError, match=f"^{error}"):
        parse(values, [YARD, HOOK, "events/", "t.csv"])


@pytest.mark.parametrize(
    ("place", "values", "error"),
    [
        ("t.csv", {"when": "lost=10"}, "when has no effect on these destinations: omit it, or add mqtt://"),
        ("events/", {"picture": True}, r"picture has no effect .* \(a folder always has pictures\): omit it"),
        (HOOK, {"rate": "5"}, "rate has no effect on these destinations: omit it, or add mqtt:// or mqtts://"),
        (YARD, {"secret_file": "key"}, "secret_file has no effect .* http:// or https://"),
        (HOOK, {"zone": DOOR, "when": "lost"}, "zone has no effect: add entered or left to when"),
    ],
)
def test_option_without_effect_is_an_error(place, values, error):
    with pytest.raises(SettingsError, match=error):
        parse(values, [place])


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["--zone", "1,2 3,4 5,6"], "expected NAME=TEXT, each with a new name"),
        (["--zone", "a=1,2 9,4 5,9", "--zone", "a=1,2 9,4 5,9"], "expected NAME=TEXT, each with a new name"),
        (["--rate", "5"], "--rate has no effect on these destinations: omit it, or add mqtt:// or mqtts://"),
    ],
)
def test_error_of_the_command_line_names_its_option(fail, words, error):
    assert error in fail("sink", HOOK, *words)


def test_sink_rejects_a_zone_outside_the_frame(fail, endpoint, turning):
    report = Health("detector", 0.0, {"width": 320, "height": 240, "rate": 30.0, "start": 0, "stride": 1})
    with Publisher(HEALTH, endpoint, "detector") as health, turning(lambda: health.send(report)):
        error = fail("sink", HOOK, "--zone", "door=4000,10 4900,10 4900,90", "--endpoint", endpoint)
    assert "zone door: it is outside the frame of 320x240 pixels" in error


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("mqtt://host/", "has no valid topic"),
        ("mqtt://host/a/#", "has no valid topic"),
        ("mqtt://me:1/secret@host/a", "percent-encode a /"),
        ("mqtt://host:99999/a", "port has to be 1 to 65535"),
        ("mqtt://me:secret@host:0/a", r"port has to be 1 to 65535\): expected mqtt://"),
        ("mqtt://fe80::1:2/a", "IPv6 address is in brackets"),
        ("mqtt://:1883/a", "host is missing"),
        ("mqtts://me:sec/secret@host/a", "expected mqtt://"),
        ("http://", "expected https://"),
        ("https://me:secret@/hook", "expected https://"),
        ("http://host:0/secret", "expected https://"),
        ("http://host/secret hook", "a space is %20"),
        ("ftp://me:secret@host/one", "is not a destination"),
    ],
)
def test_invalid_address_is_an_error_without_its_password(place, words):
    with pytest.raises(VideoError, match=words) as error:
        check_sink(place, SinkOptions())
    assert "secret" not in str(error.value)
