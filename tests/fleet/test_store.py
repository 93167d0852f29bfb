"""The store: the same laws in a folder and on an S3 server; full disks, lost servers, hidden credentials."""

import logging
import os
import resource
import secrets
import socket
import stat
import traceback

import httpx
import obstore
import pytest
from obstore.store import S3Store

from catstream.errors import FencedError, FleetError, StoreError
from catstream.fleet import store as module
from catstream.fleet.store import Contents, Store

STATE = {"job.safetensors": secrets.token_bytes(300), "trees/12.safetensors": b""}
SECRETS = {
    "AWS_ACCESS_KEY_ID": "AKIA-not-to-be-seen",
    "AWS_SECRET_ACCESS_KEY": "secret-not-to-be-seen",
    "AWS_SESSION_TOKEN": "token-not-to-be-seen",
}


@pytest.fixture(scope="module")
def s3_server():
    """An S3 server with an empty bucket, and its address in the environment."""
    from moto.moto_server.threaded_moto_server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SECRETS.items():
            patch.setenv(name, value)
        patch.setenv("AWS_ENDPOINT_URL", "http://{}:{}".format(*server.get_host_and_port()))
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        httpx.put(os.environ["AWS_ENDPOINT_URL"] + "/fleet", timeout=500)  # creates the bucket
        yield server
    server.stop()


@pytest.fixture(params=["file", "s3"])
def url(request, tmp_path):
    if request.param == "file":
        return str(tmp_path)
    request.getfixturevalue("s3_server")
    return f"s3://fleet/{secrets.token_hex(4)}"


@pytest.fixture
def store(url):
    return Store(url)


def listed(store, stream="cam-7"):
    found = Contents.of(store.names(f"streams/{stream}"))
    return sorted(found.claims), sorted(map(tuple, found.states))


def test_two_states_stay_until_a_later_claim_has_written_two(store):
    claim = store.stream("cam-7").claim()
    for frame in range(9):
        claim.write(STATE, {"frame": frame})
    assert listed(store) == ([1], [(1, 8), (1, 9)])
    claim = store.stream("cam-7").claim()
    claim.write(STATE, {"frame": 10})
    assert listed(store) == ([1, 2], [(1, 9), (2, 1)])
    claim.write(STATE, {"frame": 11})
    assert listed(store) == ([2], [(2, 1), (2, 2)])


def test_removed_stream_starts_empty_and_fences_its_old_writer(store):
    old = store.stream("cam-7").claim()
    old.write(STATE, {"frame": 1})
    store.stream("cam-7").clear()
    store.stream("never-seen").clear()
    assert store.stream("cam-7").newest() is None
    for _ in range(2):
        with pytest.raises(FencedError, match=r"cam-7 was claimed by another process \(token 2\) after this one"):
            old.write(STATE, {"frame": 2})
    new = store.stream("cam-7").claim()
    assert (new.state, new.token > old.token) == (None, True)


def test_missing_folder_is_not_created_by_a_claim(tmp_path):
    """It may be a file system that is not mounted on this machine."""
    store = Store(str(tmp_path / "share"))
    with pytest.raises(StoreError, match="is its file system mounted"):
        store.stream("cam-7").claim()
    store.check()
    assert store.stream("cam-7").claim().token == 1


def test_folders_of_a_store_are_private(tmp_path):
    Store(str(tmp_path)).check()
    assert [stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()] == [0o700] * 3


def test_full_disk_is_a_store_error_and_a_later_write_succeeds(tmp_path):
    claim = Store(str(tmp_path)).stream("cam-7").claim()
    claim.write(STATE, {"frame": 1})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        said = r"streams/cam-7/0+1/0+2 of the store .* cannot be written: .*free some space"
        with pytest.raises(StoreError, match=said):
            claim.write({"state": bytes(5000)}, {"frame": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert Store(str(tmp_path)).stream("cam-7").newest().facts == {"frame": 1}
    claim.write(STATE, {"frame": 3})
    assert Store(str(tmp_path)).stream("cam-7").newest().facts == {"frame": 3}


def test_partial_state_of_a_killed_writer_is_removed(tmp_path):
    store = Store(str(tmp_path))
    store.stream("cam-7").claim().write(STATE, {})
    part = tmp_path / "streams" / "cam-7" / "00000001" / "00000002#1"
    part.write_bytes(b"half a state")
    claim = store.stream("cam-7").claim()
    for _ in range(2):
        claim.write(STATE, {})
    assert not part.parent.exists()


def test_silent_server_is_a_store_error_after_the_timeout(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setattr(module, "STORE_SECONDS", 0.2)
        monkeypatch.setenv("AWS_ENDPOINT_URL", "http://{}:{}".format(*silent.getsockname()))
        for name, value in SECRETS.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(StoreError, match=r"no answer within 0\.2 s"):
            Store("s3://fleet").stream("cam-7").newest()


@pytest.mark.parametrize(
    "url",
    [
        "s3://AKIA-not-to-be-seen:secret-not-to-be-seen@fleet/prefix",
        "s3://fleet/prefix?token=token-not-to-be-seen",
        "https://AKIA-not-to-be-seen@host/fleet",
        "gs://not-to-be-seen",
        "s3://Not-To-Be-Seen",
    ],
)
def test_invalid_url_is_rejected_without_its_credentials(url):
    with pytest.raises(FleetError) as refused:
        Store(url)
    assert "not-to-be-seen" not in str(refused.value).lower()


@pytest.mark.usefixtures("s3_server")
@pytest.mark.parametrize("url", ["s3://fleet/p", "s3://no-such-bucket/p", "s3://unreachable/p"])
def test_errors_and_logs_contain_no_credentials(url, caplog, monkeypatch):
    caplog.set_level(logging.DEBUG)
    if "unreachable" in url:
        monkeypatch.setenv("AWS_ENDPOINT_URL", "http://user:password-not-to-be-seen@127.0.0.1:9")
    shown = []
    try:
        Store(url).stream("cam-7").claim().write(STATE, {})
    except StoreError as error:
        shown += traceback.format_exception(error)
    assert "not-to-be-seen" not in "".join([*shown, *(record.getMessage() for record in caplog.records)])


@pytest.mark.usefixtures("s3_server")
def test_missing_bucket_and_missing_credentials_are_named(monkeypatch):
    with pytest.raises(StoreError, match=r"answered NoSuchBucket: check the bucket, its region \(AWS_REGION\)"):
        Store("s3://no-such-bucket").stream("cam-7").claim()
    for name in SECRETS:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")  # of the machine's role
    with pytest.raises(StoreError, match="no credentials were found: set AWS_ACCESS_KEY_ID"):
        Store("s3://fleet").stream("cam-7").claim()


@pytest.mark.usefixtures("s3_server")
def test_server_that_ignores_if_none_match_is_rejected(monkeypatch):
    store = Store("s3://fleet/overwrites")
    monkeypatch.setattr(S3Store, "put", lambda *given, **_: obstore.put(*given))
    with pytest.raises(StoreError, match="ignores If-None-Match"):
        store.check()
