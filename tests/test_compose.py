"""The services of the compose files run, without Docker: their commands, environment and health checks."""

import os
import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import yaml

from catstream.client.attach import subscribe
from catstream.processes.start_server import NAMES
from catstream.wire import keys

ROOT = Path(__file__).parents[1]
SERVICES, WITH_KEYS = (
    yaml.safe_load((ROOT / name).read_text())["services"] for name in ("docker-compose.yml", "docker-compose.keys.yml")
)
SCRIPTS = "/opt/catstream/services"  # in the image


def filled_in(text, **variables):
    """A text with its variables replaced, as docker compose does it."""
    return re.sub(r"\$\{(\w+):[-?]([^}]*)\}", lambda match: variables.get(match[1], match[2]), text)


def test_a_subscriber_outside_of_the_containers_receives_from_the_services(demo_video, tmp_path, tcp, monkeypatch):
    path, truth = demo_video(60)
    keys.create(tmp_path / "pipeline")
    keys.allow(tmp_path / "pipeline", "phone", "watch", tmp_path / "phone")
    here = {"/keys": str(tmp_path), "/state": str(tmp_path / "state"), SCRIPTS: str(ROOT / "services")}
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
        *_, script, address = SERVICES["trainer"]["healthcheck"]["test"]
        monkeypatch.setenv("CATSTREAM_RUN_KEYS", str(tmp_path / "pipeline"))
        health = address.replace("5707", str(int(tcp.rpartition(":")[2]) + 7))
        subprocess.run([sys.executable, "-P", "-c", script, health], check=True)
