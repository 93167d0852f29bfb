"""The addresses of destinations on the network."""

import pytest

from catstream.errors import VideoError
from catstream.output.destinations import SinkOptions, check_sink


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
