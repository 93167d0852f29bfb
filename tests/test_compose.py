"""docker-compose.yml and its image, held to the table of channels and to the processes: no Docker engine is needed."""

import os
import re
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import yaml

from catstream.base.settings import Settings
from catstream.cli import group
from catstream.client.address import Address
from catstream.client.attach import subscribe
from catstream.messages.kinds import Health
from catstream.processes.by_hand import parser
from catstream.processes.start_server import NAMES
from catstream.web.app import pipeline_site
from catstream.web.server import Server
from catstream.wire import keys
from catstream.wire.channels import CHANNELS, HEALTH
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher

ROOT = Path(__file__).parents[1]
SERVICES = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
WITH_KEYS = yaml.safe_load((ROOT / "docker-compose.keys.yml").read_text())["services"]
IMAGE = (ROOT / "services" / "Dockerfile").read_text()
PLACE = "/opt/catstream/services"  # in the image
PROCESSES = pytest.mark.parametrize("name", NAMES)


def filled_in(text, **variables):
    """A text with its variables replaced, as docker compose does it."""

    def value(match):
        name, sign, other = match[1], match[2], match[3]
        assert name in variables or sign == ":-", f"{name} is needed: {other}"
        return variables.get(name, other)

    return re.sub(r"\$\{(\w+)(?:(:[-?])([^}]*))?\}", value, text)


def words(name):
    """The command line of a service, with its variables replaced."""
    return [filled_in(word, SOURCE="walk.mp4", BOX="1,2,30,40") for word in SERVICES[name]["command"]]


def parsed(name):
    """The entry point of a service, and its arguments."""
    place, *rest = words(name)
    return place, vars(parser(name).parse_args(rest))


def settings(name):
    """What a service runs with: its options over its environment."""
    environment = SERVICES[name]["environment"]
    return Settings.load(overrides=parsed(name)[1]["pairs"], environment=environment)


def published(service):
    """The addresses and the ports of this host that a service is reached at."""
    for line in service["ports"]:
        address, ports, _ = re.fullmatch(r"([\d.]+):([\d-]+):([\d-]+)", filled_in(line)).groups()
        first, _, last = ports.partition("-")
        yield from ((address, port) for port in range(int(first), int(last or first) + 1))


def test_there_is_a_service_for_each_process_for_the_page_and_for_the_network():
    assert set(SERVICES) == {*NAMES, "view", "network"}
    assert {service["image"] for service in SERVICES.values()} == {"catstream"}
    assert all("build" in service for service in SERVICES.values()), "each of them may be the first that is run"


@PROCESSES
def test_each_process_accepts_its_command_line(name):
    assert parsed(name)[0] == f"{PLACE}/{name}.py"
    assert (ROOT / "services" / f"{name}.py").exists()
    assert f"COPY services {PLACE}" in IMAGE


def test_services_share_a_network_of_their_own_and_only_the_page_is_published():
    (endpoint,) = {settings(name).run.endpoint for name in NAMES}
    assert Endpoint.parse(endpoint).host == "127.0.0.1"
    assert {SERVICES[name]["network_mode"] for name in (*NAMES, "view")} == {"service:network"}
    assert {name for name, service in SERVICES.items() if "ports" in service} == {"network"}
    assert list(published(SERVICES["network"])) == [("127.0.0.1", 8000)]


def test_the_page_asks_for_its_token_and_finds_the_pipeline(monkeypatch):
    monkeypatch.setenv("VIEW_TOKEN", "0123456789abcdef")
    service = SERVICES["view"]
    assert (service["entrypoint"], service["profiles"]) == (["catstream"], ["view"])
    assert set(service["environment"]) == {"VIEW_TOKEN"}
    assert filled_in(service["environment"]["VIEW_TOKEN"]) == "", "without one of the user the page makes one"
    assert "--token" not in service["command"]
    options = group.make_context("catstream", list(service["command"]))
    verb, command, rest = group.resolve_command(options, service["command"])
    page = command.make_context(verb, rest, parent=options).params
    assert (page["endpoint"], page["listen"].port) == (settings("detector").run.endpoint, 8000)
    server = Server(pipeline_site(Address(page["endpoint"])), host=page["listen"].host, port=0, token=page["token"])
    script = service["healthcheck"]["test"][-1].replace(":8000", f":{urlsplit(server.url).port}")
    with server.in_background():
        subprocess.run([sys.executable, "-P", "-c", script], check=True)


def test_a_process_that_dies_resumes_from_its_state():
    assert all(SERVICES[name]["restart"].startswith("on-failure") for name in NAMES)
    assert f"state:{parsed('compressor')[1]['state']}" in SERVICES["compressor"]["volumes"]
    assert parsed("detector")[1]["resume"]


def test_the_video_is_mounted_read_only_and_named_by_the_user():
    _, options = parsed("detector")
    assert f"{SERVICES['detector']['working_dir']}/{options['source']}" == "/videos/walk.mp4"
    assert options["boxes"] == ["1,2,30,40"]
    assert [filled_in(volume, VIDEOS="/films") for volume in SERVICES["detector"]["volumes"]] == ["/films:/videos:ro"]
    for name in ("SOURCE", "BOX"):
        assert f"${{{name}:?" in " ".join(SERVICES["detector"]["command"])


@PROCESSES
def test_the_health_check_receives_from_its_process_and_detects_silence(name, tcp):
    *command, script, address = SERVICES[name]["healthcheck"]["test"]
    assert command == ["CMD", "python", "-P", "-c"]
    compose = Endpoint.parse(settings(name).run.endpoint)
    assert address == compose.address(CHANNELS["health"], name)

    endpoint = Endpoint.parse(tcp)
    check = [sys.executable, "-c", script, endpoint.address(CHANNELS["health"], name)]
    assert subprocess.run([*check[:2], script.replace("5000", "300"), check[3]]).returncode == 1
    with Publisher(HEALTH, endpoint, name) as health, subprocess.Popen(check) as hearing:
        health.send(Health(name, 0.0))
        while hearing.poll() is None:
            health.serve_late_joiners()
            time.sleep(0.01)
    assert hearing.returncode == 0


def test_ports_for_subscribers_are_published_on_this_host_alone_if_there_are_keys():
    compose = Endpoint.parse(settings("detector").run.endpoint)
    wanted = {
        int(compose.address(channel, sender).rpartition(":")[2])
        for channel in CHANNELS.values()
        if channel.role in ("watch", "control")
        for sender in channel.senders
    }
    assert set(published(WITH_KEYS["network"])) == {("127.0.0.1", port) for port in wanted}


def test_a_subscriber_outside_of_the_containers_attaches_with_keys(demo_video, tmp_path, tcp, monkeypatch):
    path, truth = demo_video(60)
    keys.create(tmp_path / "pipeline")
    keys.allow(tmp_path / "pipeline", "phone", "watch", tmp_path / "phone")
    here = {"/keys": str(tmp_path), "/state": str(tmp_path / "state"), PLACE: str(ROOT / "services")}
    here["tcp://0.0.0.0:5700"] = tcp.replace("127.0.0.1", "0.0.0.0")
    monkeypatch.chdir(path.parent)
    with ExitStack() as stack:
        for name in NAMES:
            variables = {**SERVICES[name]["environment"], **WITH_KEYS[name]["environment"]}
            line = [filled_in(word, SOURCE=path.name, BOX=str(truth[0])) for word in SERVICES[name]["command"]]
            for there, place in here.items():
                variables = {key: value.replace(there, place) for key, value in variables.items()}
                line = [word.replace(there, place) for word in line]
            service = [sys.executable, "-P", *line]
            process = stack.enter_context(subprocess.Popen(service, env=os.environ | variables))
            stack.callback(process.kill)
        with subscribe(tcp, "tracks", keys=str(tmp_path / "phone"), timeout=150) as tracks:
            assert next(tracks).box is not None
        first = int(tcp.rpartition(":")[2])
        *_, script, address = SERVICES["trainer"]["healthcheck"]["test"]
        monkeypatch.setenv("CATSTREAM_RUN_KEYS", str(tmp_path / "pipeline"))
        heard = address.replace("5707", str(first + 7))
        subprocess.run([sys.executable, "-P", "-c", script, heard], check=True)


def test_the_image_is_pinned_runs_the_processes_and_is_nobody_in_particular():
    assert "pip install --require-hashes -r requirements.lock" in IMAGE
    assert 'ENTRYPOINT ["python", "-P"]' in IMAGE
    last = IMAGE.rpartition("FROM ")[2]
    assert re.search(r"^USER (?!root)\w+$", last, re.MULTILINE)
    assert last.index("USER ") < last.index("import catstream"), "the kernels belong to who runs them"


def test_the_image_is_made_of_files_that_are_there():
    sources = re.findall(r"^COPY (?!--from)(.+) \S+$", IMAGE, re.MULTILINE)
    files = {file for line in sources for file in line.split()}
    assert all((ROOT / file).exists() for file in files)
    allowed = (ROOT / ".dockerignore").read_text().splitlines()
    assert {line.removeprefix("!") for line in allowed if line.startswith("!")} == files
