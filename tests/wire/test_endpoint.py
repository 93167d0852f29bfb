"""Endpoints: their addresses, their private folders, and the discovery of running pipelines."""

import os
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest.mock import Mock

import pytest

from catstream.errors import ServiceError
from catstream.wire.channels import CHANNELS
from catstream.wire.discovery import find, private_folder, reserve_endpoint, running, source_at
from catstream.wire.endpoint import Endpoint
from catstream.wire.keys import Keys, create

PLACES = [(channel, sender) for channel in CHANNELS.values() for sender in channel.senders]


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_ports_follow_the_table():
    endpoint = Endpoint.parse("tcp://127.0.0.1:6000")
    for channel, sender in PLACES:
        port = 6000 + channel.port + channel.senders.index(sender)
        assert endpoint.address(channel, sender) == f"tcp://127.0.0.1:{port}"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "localhost", "[::1]"])
@pytest.mark.parametrize("other", ["0.0.0.0", "192.168.1.1", "[fe80::1%eth0]", "example.org", "*", "127.0.0.1.nip.io"])
def test_endpoint_of_other_machines_requires_keys(host, other):
    assert Endpoint.parse(f"tcp://{host}:5700").port == 5700
    with pytest.raises(ServiceError, match="other machines"):
        Endpoint.parse(f"tcp://{other}:5700")


def test_host_name_is_resolved_to_its_address_family(folder, monkeypatch):
    create(folder / "keys")
    known = {"four": ["192.0.2.1"], "six": ["2001:db8::1"], "both": ["2001:db8::1", "192.0.2.1"]}

    def found(host, *_, **__):
        families = [socket.AF_INET6 if ":" in each else socket.AF_INET for each in known[host]]
        return [(family, 0, 0, "", (each, 0)) for family, each in zip(families, known[host], strict=True)]

    monkeypatch.setattr(socket, "getaddrinfo", found)
    places = {name: Endpoint.parse(f"tcp://{name}:5700", str(folder / "keys")) for name in known}
    assert [places[name].is_ipv6 for name in ("four", "six", "both")] == [False, True, False]
    addresses = [places[name].listening(CHANNELS["models"]) for name in ("four", "six", "both")]
    assert addresses == ["tcp://192.0.2.1:5702", "tcp://[2001:db8::1]:5702", "tcp://192.0.2.1:5702"]


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "--set run.endpoint"),
        ("udp://127.0.0.1:1", "a folder or tcp"),
        ("x" * 100, "too long.*TMPDIR"),
        *((f"tcp://{rest}", "more ports after PORT") for rest in ("", "127.0.0.1", ":5700", "[:5700", "[12]:5700")),
        *((f"tcp://127.0.0.1:{port}", "more ports after PORT") for port in ("0", "65535", "x")),
        *((text, "a folder or tcp") for text in ("localhost:5700", ":5700", "tcp:/camera:5700", "//[::1]:5700/")),
    ],
)
def test_invalid_endpoint_is_an_error(text, word):
    with pytest.raises(ServiceError, match=word):
        Endpoint.parse(text)


@pytest.mark.parametrize("disk", [65_536], indirect=True)
def test_full_disk_for_temporary_files_is_an_error_that_names_it(disk, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(disk))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)  # otherwise used if the paths on the disk are too long
    (disk / "ballast").write_bytes(bytes(65_536))
    with (
        pytest.raises(ServiceError, match=f"{disk}.*No space left"),
        private_folder() as folder,
        reserve_endpoint("tcp://127.0.0.1:5700", folder, source="walk.mp4"),
    ):
        pass
    assert [file.name for file in disk.iterdir()] == ["ballast"]


def test_no_folder_for_temporary_files_is_an_error(monkeypatch):
    monkeypatch.setattr(tempfile, "gettempdir", Mock(side_effect=FileNotFoundError))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    with pytest.raises(ServiceError, match="TMPDIR"), private_folder():
        pass
    assert running() == []


def test_folder_of_sockets_is_private_to_this_user(folder):
    with reserve_endpoint(str(folder / "a" / "b"), folder):
        assert mode(folder / "a" / "b") == 0o700
    (folder / "file").touch()
    (folder / "open").mkdir()
    (folder / "open").chmod(0o777)
    bad = {"file": "is a file", "open": "other users may write"}
    if os.geteuid() == 0:  # only root can give a folder away
        (folder / "theirs").mkdir(mode=0o755)
        os.chown(folder / "theirs", 12345, 12345)
        bad["theirs"] = "a folder of your own"
    for name, problem in bad.items():
        with pytest.raises(ServiceError, match=problem), reserve_endpoint(str(folder / name), folder):
            pass


#: Is killed while it has a private folder; prints the folder.
KILLED = """
import os, signal
from catstream.wire.discovery import private_folder, reserve_endpoint
with private_folder() as folder, reserve_endpoint("", folder) as endpoint:
    print(endpoint, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_private_folder_of_a_killed_process_is_removed(folder, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    left = Path(subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True).stdout.strip())
    assert (left / "endpoint").read_text() == f"{left}\n\n"
    assert running() == []
    with private_folder() as first, private_folder() as second:
        assert not left.exists()
        assert mode(first) == mode(second) == 0o700
    assert not first.exists()


def test_pipeline_leaves_no_socket_files(folder):
    before = set(folder.iterdir())
    with reserve_endpoint(str(folder), folder) as endpoint:
        for channel, sender in PLACES:
            Path(endpoint.address(channel, sender).removeprefix("ipc://")).touch()
    assert set(folder.iterdir()) == before


@pytest.mark.parametrize("place", ["", "run", "tcp://127.0.0.1:5999"], ids=["a folder of its own", "a folder", "tcp"])
def test_running_pipeline_is_found_until_it_ends(folder, place):
    place = str(folder / place) if place == "run" else place
    source = os.fsdecode(b"walk\xff.mp4")  # not UTF-8
    with private_folder() as private, reserve_endpoint(place, private, source=source) as endpoint:
        assert endpoint in running()
        assert source_at(endpoint) == source
    assert endpoint not in running()


def test_pipeline_with_unreadable_keys_hides_no_other(tmp_path):
    create(tmp_path / "keys")
    with (
        private_folder() as one,
        reserve_endpoint("", one, source="good.mp4") as good,
        private_folder() as two,
        reserve_endpoint("tcp://127.0.0.1:5998", two, str(tmp_path / "keys"), "other.mp4") as other,
    ):
        found = {str(endpoint): endpoint.keys for endpoint in running()}
        assert (found[str(good)], found[str(other)]) == (None, Keys.load(tmp_path / "keys"))
        shutil.move(tmp_path / "keys", tmp_path / "moved")
        assert str(good) in {str(endpoint) for endpoint in running()}
        assert str(other) not in {str(endpoint) for endpoint in running()}
        assert find().source == source_at(Endpoint.parse(str(good))) == "good.mp4"
