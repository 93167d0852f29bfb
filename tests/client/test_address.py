"""Addresses of pipelines and of streams of a fleet."""

import pytest

from catstream.client.address import Address
from catstream.errors import ServiceError
from catstream.wire.discovery import private_folder, reserve_endpoint


@pytest.mark.parametrize("fleet", ["", "site", "head:5690", "[::1]:5690"])
def test_text_of_an_address_is_parsed_to_the_same_address(fleet):
    address = Address(stream="cam-7", fleet=fleet)
    assert Address.parse(str(address)) == address
    assert Address.parse(address) is address


@pytest.mark.parametrize("text", ["fleet://", "fleet://site/", "fleet://a/b/c", "fleet://head:5690"])
def test_malformed_address_of_a_stream_is_an_error(text):
    with pytest.raises(ServiceError, match="the address of a stream is"):
        Address.parse(text)


@pytest.mark.parametrize("text", ["", "run", "tcp://127.0.0.1:5700"])
def test_other_text_is_the_endpoint_of_a_pipeline(text):
    assert Address.parse(text, "keys") == Address(text, keys="keys")


def test_empty_address_is_the_only_running_pipeline():
    with private_folder() as folder, reserve_endpoint("", folder, source="walk.mp4") as only:
        address = Address().with_endpoint()
        with private_folder() as folder, reserve_endpoint("", folder, source="run.mp4"):
            assert address.resolve() == only
            with pytest.raises(ServiceError, match="2 pipelines are running"):
                Address().resolve()
    assert address.with_endpoint() is address
