"""Where the processes meet, and who is kept out."""

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
def test_without_keys_only_endpoints_of_this_machine_are_accepted(host, other):
    assert Endpoint.parse(f"tcp://{host}:5700").port == 5700
    with pytest.raises(ServiceError, match="other machines"):
        Endpoint.parse(f"tcp://{other}:5700")


def test_a_host_name_of_one_address_family_is_listened_on_and_resolved_in_it(folder, monkeypatch):
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
    ],
)
def test_an_invalid_endpoint_is_rejected(text, word):
    with pytest.raises(ServiceError, match=word):
        Endpoint.parse(text)


def test_a_private_folder_is_for_this_user_and_removed_afterwards():
    with private_folder() as folder:
        assert mode(folder) == 0o700
        (folder / "features").touch()
    assert not folder.exists()


@pytest.mark.parametrize("disk", [65_536], indirect=True)
def test_a_full_disk_for_temporary_files_is_an_error_that_names_it(disk, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(disk))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)  # which is taken if the names of the disk's are too long
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


def test_a_folder_that_is_made_is_for_this_user_alone_and_another_one_has_to_be(folder):
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


def killed(place: str = "") -> Path:
    """Kill a pipeline that meets in a folder, or in a private one; returns the folder."""
    script = "import os, signal, sys; from catstream.wire.discovery import reserve_endpoint, private_folder\n"
    script += "with private_folder() as private, reserve_endpoint(sys.argv[1], private) as endpoint:\n"
    script += "    print(endpoint, flush=True)\n    os.kill(os.getpid(), signal.SIGKILL)"
    return Path(subprocess.run([sys.executable, "-c", script, place], capture_output=True, text=True).stdout.strip())


def test_the_folder_of_a_killed_process_is_removed_and_that_of_a_running_one_is_not(folder, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    left = killed()
    assert (left / "endpoint").read_text() == f"{left}\n\n"
    assert running() == []
    with private_folder() as first, private_folder() as second:
        assert not left.exists()
        assert first.exists()
        assert second.exists()


def test_no_socket_file_is_left_of_a_pipeline(folder):
    before = set(folder.iterdir())
    with reserve_endpoint(str(folder), folder) as endpoint:
        for channel, sender in PLACES:
            Path(endpoint.address(channel, sender).removeprefix("ipc://")).touch()
    assert set(folder.iterdir()) == before


@pytest.mark.parametrize("place", ["", "run", "tcp://127.0.0.1:5999"], ids=["a folder of its own", "a folder", "tcp"])
def test_a_running_pipeline_is_found_until_it_ends(folder, place):
    place = str(folder / place) if place == "run" else place
    with private_folder() as private, reserve_endpoint(place, private) as endpoint:
        assert endpoint in running()
    assert endpoint not in running()


def test_only_running_pipeline_is_found_if_the_name_of_its_source_is_not_utf_8():
    source = os.fsdecode(b"walk\xff.mp4")
    with private_folder() as own, reserve_endpoint("", own, source=source) as endpoint:
        assert (str(find()), find().source) == (str(endpoint), source)


def test_a_pipeline_is_found_with_its_keys_and_hides_no_other_if_they_cannot_be_read(tmp_path):
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


@pytest.mark.parametrize("text", ["localhost:5700", ":5700", "tcp:/camera.example.org:5700", "//[::1]:5700/"])
def test_an_address_without_its_prefix_is_not_taken_for_a_folder(text, folder, monkeypatch):
    monkeypatch.chdir(folder)
    with pytest.raises(ServiceError, match="a folder or tcp://HOST:PORT, got"):
        Endpoint.parse(text)
    if "/" not in text:
        (folder / text).mkdir()
        assert Endpoint.parse(text).folder == Path(text)
