"""The services of docker-compose.yml, without Docker: their privileges, and a run of them without any variable."""

import os
import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import yaml

from catstream.client.attach import control
from catstream.processes.start_server import NAMES
from catstream.video.live_demo import first_box

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docker-compose.yml").read_text()
VARIABLE = r"\$\{(\w+):-([^}]*)\}"  # with its default
SERVICES = yaml.safe_load(re.sub(VARIABLE, r"\2", TEXT).replace("$$", "$"))["services"]


def test_services_have_no_privileges_and_one_local_port():
    assert SERVICES.keys() == {*NAMES, "view", "tracks"}
    assert [port for service in SERVICES.values() for port in service.get("ports", [])] == ["127.0.0.1:8000:8000"]
    for service in SERVICES.values():
        assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
        assert (service["security_opt"], service["restart"]) == (["no-new-privileges:true"], "unless-stopped")
        assert service.get("network_mode", "none") == "none"


def test_services_track_an_object_whose_box_is_set_later(folder, tmp_path, until):
    (folder / "run").mkdir(mode=0o700)
    (tmp_path / "tracks").mkdir()
    places = {"/opt/catstream": ROOT, "/state": folder, "/tracks": tmp_path / "tracks", "0.0.0.0:8000": "127.0.0.1:0"}

    def here(words):
        return [re.sub("|".join(places), lambda match: str(places[match[0]]), word) for word in words]

    run, path, processes = str(folder / "run"), f"{Path(sys.executable).parent}:{os.environ['PATH']}", {}
    variables = os.environ | {"PATH": path, "CATSTREAM_RUN_ENDPOINT": run, "SINK": ""}
    with ExitStack() as stack:
        for name, service in SERVICES.items():
            words = service.get("entrypoint", [sys.executable, "-P"]) + service.get("command", [])
            process = subprocess.Popen(here(words), env=variables, stdout=subprocess.PIPE, text=True)
            processes[name] = stack.enter_context(process)
            stack.callback(process.kill)
        assert processes["view"].stdout.readline().startswith("http://127.0.0.1:")
        for name in NAMES:
            _, _, *check = here(SERVICES[name]["healthcheck"]["test"])
            until(lambda check=check: subprocess.run([sys.executable, *check], check=False).returncode == 0)
        with control(run, timeout=500) as pipeline:
            pipeline.set_box(first_box("demo:1"))
        until(lambda: any('"box"' in log.read_text() for log in (tmp_path / "tracks").glob("*.ndjson")))
        processes["detector"].terminate()
        assert [processes[name].wait(500) for name in (*NAMES, "tracks")] == [0] * 4
