"""The registry of a fleet: its state arrives whole, and only clients with a key of the fleet get an answer."""

import socket
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from unittest.mock import Mock

import pytest

from catstream.client.address import Address
from catstream.client.registry import Registry
from catstream.errors import ServiceError
from catstream.wire.channels import REGISTRY
from catstream.wire.commands import Responder
from catstream.wire.discovery import find, fleets, reserve_endpoint, running
from catstream.wire.keys import Client, Keys, allow, clients, create, synchronise
from catstream.wire.messages import FleetStatus, Listing, NodeStatus, Question, StreamStatus

CAM = StreamStatus("cam-7", "running", "north", "walk.mp4", "run", token=3)
SITE = FleetStatus("site", 1.7e9, {"cam-7": CAM}, {"north": NodeStatus("north", "alive")})


def test_state_of_thousands_of_streams_arrives_whole(managing):
    streams = {name: replace(CAM, name=name, trouble="x" * 500) for name in (f"cam-{n}" for n in range(10_000))}
    many = FleetStatus("site", 1.7e9, streams, {f"n-{n}": NodeStatus(f"n-{n}", "alive") for n in range(300)})
    with managing(many), Registry() as registry:
        assert registry.streams() == many
        status = registry.stream("cam-7")
        endpoint = registry.endpoint_of(status)
    assert (status, str(endpoint), endpoint.source) == (streams["cam-7"], "run", "walk.mp4")


@pytest.mark.parametrize("answer", [b"{}", b'{"name": 3', b"{" + b'"a": [' * 100_000])
def test_invalid_answer_of_a_registry_is_an_error(folder, answer):
    with (
        reserve_endpoint("", folder, fleet="site") as place,
        Responder[Question, Listing](REGISTRY, place) as responder,
    ):

        def serve():
            for question in responder.receive_all(20):
                responder.answer(Listing(question.id, answer))

        with Registry(timeout=500) as registry, ThreadPoolExecutor(1) as pool:
            served = pool.submit(serve)
            with pytest.raises(ServiceError, match="invalid answer of the registry"):
                registry.streams()
            served.result()


def test_discovery_separates_fleets_and_pipelines(folder, managing):
    with managing(SITE) as controller, reserve_endpoint("", folder, source="walk.mp4") as pipeline:
        assert fleets() == {"site": controller}
        assert running() == [pipeline]
        assert find() == pipeline
        assert (
            str(Address.parse("fleet://cam-7").resolve()) == str(Address.parse("fleet://site/cam-7").resolve()) == "run"
        )
    assert fleets() == {}


def test_fleet_is_selected_by_its_name_if_several_run(managing):
    with pytest.raises(ServiceError, match=r"no fleet of yours is running: start it \(catstream fleet up\)"):
        Registry()
    with managing(SITE):
        with pytest.raises(ServiceError, match=r"no fleet 'yard' of yours is running, only site"):
            Registry("yard")
        with managing(replace(SITE, name="yard")):
            with Registry("yard") as registry:
                assert registry.streams().name == "yard"
            with pytest.raises(ServiceError, match=r"2 fleets are running: select one .* site, yard"):
                Registry()


def test_unknown_host_of_a_fleet_is_an_error_without_keys(monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", Mock(side_effect=socket.gaierror))
    with pytest.raises(ServiceError, match="the host 'haed' of the fleet is unknown"):
        Address.parse("fleet://haed:5690/cam-7").resolve()


def test_stream_allows_the_clients_of_its_fleet(keys, folder):
    stream = folder / "stream"
    create(stream)
    own = clients(stream)["pipeline"]
    allow(stream, "old", "control", output=folder / "old")
    synchronise(stream, clients(keys))
    of_fleet = clients(keys)
    assert clients(stream) == {"pipeline": own, "fleet.pipeline": of_fleet["pipeline"], "anna": of_fleet["anna"]}
    (keys / "clients" / "anna").unlink()
    allow(keys, "anna", "control", output=folder / "new")
    synchronise(stream, clients(keys))
    assert clients(stream)["anna"] == Client("control", Keys.load(folder / "new").public.decode())
    assert (stream / "clients" / "anna").stat().st_mode & 0o777 == 0o600
