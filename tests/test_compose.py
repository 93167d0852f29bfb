"""docker-compose.yml and its image, held to the table of channels and to the processes: no Docker engine is needed."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from catstream.box import Box
from catstream.messages import Health
from catstream.services.__main__ import main
from catstream.services.supervisor import NAMES
from catstream.settings import Settings
from catstream.wire.channels import CHANNELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.sockets import Publisher

ROOT = Path(__file__).parents[1]
SERVICES = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
IMAGE = (ROOT / "services" / "Dockerfile").read_text()
PROCESSES = pytest.mark.parametrize("name", NAMES)


def filled_in(text, **variables):
    """A text with its variables replaced, as docker compose does it."""

    def value(match):
        name, sign, other = match[1], match[2], match[3]
        assert name in variables or sign == ":-", f"{name} is needed: {other}"
        return variables.get(name, other)

    return re.sub(r"\$\{(\w+)(?:(:[-?])([^}]*))?\}", value, text)


def parsed(name):
    """What the command line of a service says, read by the parser of `catstream.services`."""
    words = [filled_in(word, SOURCE="walk.mp4", BOX="1,2,30,40") for word in SERVICES[name]["command"]]
    with main.make_context("catstream.services", list(words)) as context:
        verb, command, rest = main.resolve_command(context, words)
        return verb, command.make_context(verb, rest, parent=context).params


def test_there_is_a_service_for_each_process_and_one_that_holds_the_network():
    assert set(SERVICES) == {*NAMES, "network"}
    assert {service["image"] for service in SERVICES.values()} == {"catstream"}


@PROCESSES
def test_each_process_accepts_its_command_line(name):
    verb, options = parsed(name)
    assert verb == name
    Settings.load(overrides=options["pairs"], environment={})


def test_all_meet_at_one_endpoint_inside_one_network_that_nobody_else_is_in():
    (endpoint,) = {Settings.load(overrides=parsed(name)[1]["pairs"], environment={}).endpoint for name in NAMES}
    assert Endpoint.parse(endpoint).host == "127.0.0.1"
    assert {SERVICES[name]["network_mode"] for name in NAMES} == {"service:network"}
    assert SERVICES["network"]["network_mode"] == "none"
    assert not any("ports" in service for service in SERVICES.values())


def test_who_dies_goes_on_where_it_stopped():
    assert all(SERVICES[name]["restart"].startswith("on-failure") for name in NAMES)
    assert f"state:{parsed('compressor')[1]['state']}" in SERVICES["compressor"]["volumes"]
    assert parsed("detector")[1]["resume"]


def test_the_video_is_mounted_read_only_and_named_by_the_user():
    _, options = parsed("detector")
    assert options["source"] == "/videos/walk.mp4"
    assert Box.of(options["box"]) == (1, 2, 30, 40)
    assert [filled_in(volume, VIDEOS="/films") for volume in SERVICES["detector"]["volumes"]] == ["/films:/videos:ro"]
    for name in ("SOURCE", "BOX"):
        assert f"${{{name}:?" in " ".join(SERVICES["detector"]["command"])


@PROCESSES
def test_the_health_check_hears_its_process_and_notices_silence(name):
    command, program, flag, script, address = SERVICES[name]["healthcheck"]["test"]
    assert (command, program, flag) == ("CMD", "python", "-c")
    compose = Endpoint.parse(Settings.load(overrides=parsed(name)[1]["pairs"], environment={}).endpoint)
    assert address == compose.address(CHANNELS["health"], name)

    with socket.create_server(("127.0.0.1", 0)) as probe:
        first = min(probe.getsockname()[1], 65000)
    endpoint = Endpoint.parse(f"tcp://127.0.0.1:{first}")
    check = [sys.executable, "-c", script, endpoint.address(CHANNELS["health"], name)]
    assert subprocess.run([*check[:2], script.replace("5000", "300"), check[3]]).returncode == 1
    with Publisher("health", endpoint, name) as health, subprocess.Popen(check) as hearing:
        health.send(Health(name, 0.0))
        while hearing.poll() is None:
            health.welcome()
            time.sleep(0.01)
    assert hearing.returncode == 0


def test_the_image_is_pinned_runs_the_processes_and_is_nobody_in_particular():
    assert "pip install --require-hashes -r requirements.lock" in IMAGE
    assert 'ENTRYPOINT ["python", "-P", "-m", "catstream.services"]' in IMAGE
    last = IMAGE.rpartition("FROM ")[2]
    assert re.search(r"^USER (?!root)\w+$", last, re.MULTILINE)
    assert last.index("USER ") < last.index("import catstream"), "the kernels belong to who runs them"


def test_the_image_is_made_of_files_that_are_there():
    sources = re.findall(r"^COPY (?!--from)(.+) \S+$", IMAGE, re.MULTILINE)
    files = {file for line in sources for file in line.split()}
    assert all((ROOT / file).exists() for file in files)
    allowed = (ROOT / "services" / "Dockerfile.dockerignore").read_text().splitlines()
    assert {line.removeprefix("!") for line in allowed if line.startswith("!")} == files
