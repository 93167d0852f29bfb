"""A webhook: each event arrives once and in order after any outage, and dropped events are counted."""

import hmac
import json
from base64 import b64encode
from contextlib import closing, contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread

import pytest

from catstream.base.box import Box
from catstream.client.address import Address
from catstream.errors import VideoError
from catstream.output import remote, webhook
from catstream.output.destinations import Origin, SinkOptions, TrackedFrame, check_sink, open_sink
from catstream.output.track_log import RunFiles
from catstream.wire.channels import PREVIEWS
from catstream.wire.messages import Preview, Track
from catstream.wire.newest import Publisher

FOUND = Track(0, 0.0, "present", Box(10, 20, 30, 40), 0.9, 1, object="anna")
JPEG = b"\xff\xd8\xff a picture"


class Receiver:
    """A server that records each request, and answers with the next one of `answers`, then with 204."""

    def __init__(self, port=0):
        self.requests, self.answers, self.holds = [], [], Event()
        self.holds.set()
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.holds.wait(500)
                receiver.requests.append((self.path, self.headers, body))
                status, *retry_after = receiver.answers.pop(0) if receiver.answers else (204,)
                self.send_response(status)
                for text in retry_after:
                    self.send_header("Retry-After", text)
                self.end_headers()

            def log_message(self, *_):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self.port = self._server.server_port
        Thread(target=self._server.serve_forever, args=(0.02,)).start()

    def close(self):
        self.holds.set()
        self._server.shutdown()
        self._server.server_close()

    @property
    def bodies(self):
        return [json.loads(body) for _, _, body in self.requests]

    @property
    def events(self):
        return [(body["event"], body["time"]) for body in self.bodies]


@pytest.fixture
def receiver():
    with closing(Receiver()) as server:
        yield server


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(webhook, "_PAUSE", 0.02)
    monkeypatch.setattr(webhook, "_LONGEST_PAUSE", 0.05)
    monkeypatch.setattr(webhook, "CLOSE_SECONDS", 60.0)  # all is delivered on a busy machine
    monkeypatch.setattr(remote, "_PICTURE_SECONDS", 60.0)


@contextmanager
def sending(port, path="hook", user="", **options):
    """Opens a webhook, and writes a track with an object to it."""
    with closing(open_sink(f"http://{user}127.0.0.1:{port}/{path}", Origin(options=SinkOptions(**options)))) as sink:
        sink.write(TrackedFrame([FOUND]))
        yield sink


def lose(sink, *times):
    """Write tracks with the events lost and returned at each of these times."""
    for time in times:
        lost = replace(FOUND, frame=10 * time, time=10.0 * time, state="absent", box=None)
        sink.write(TrackedFrame([lost]))
        sink.write(TrackedFrame([replace(FOUND, frame=10 * time + 1, time=10.0 * time + 1)]))


ALL = [("found", 0.0), ("lost", 10.0), ("returned", 11.0), ("ended", 11.0)]


def test_event_is_posted_as_signed_json(receiver, tmp_path):
    (tmp_path / "key").write_text("a secret\n")
    with sending(receiver.port, "a/b?c=d", "me:p%40ss@", secret_file=tmp_path / "key") as sink:
        lose(sink, 1)
    assert receiver.events == ALL
    for path, headers, body in receiver.requests:
        assert path == "/a/b?c=d"
        assert headers["Content-Type"] == "application/json"
        assert headers["Authorization"] == f"Basic {b64encode(b'me:p@ss').decode()}"
        assert headers["X-Catstream-Signature"] == f"sha256={hmac.new(b'a secret', body, 'sha256').hexdigest()}"
    first = receiver.bodies[0]
    assert (first["track"], first["object"], first["zone"]) == (FOUND.to_dict(), "anna", None)
    assert "picture" not in first
    assert sink.missed == 0


def test_event_has_a_picture_if_requested(receiver, endpoint, until):
    options = SinkOptions(picture=True, when={"found": 0.0, "ended": 0.0})
    with Publisher(PREVIEWS, endpoint) as previews:
        url = f"http://127.0.0.1:{receiver.port}"
        with closing(open_sink(url, Origin(address=Address(str(endpoint)), options=options))) as sink:
            sink.write(TrackedFrame([FOUND]))
            until(lambda: previews.has_subscribers, previews.serve_late_joiners)
            previews.send(Preview(7, 0.28, 640, 480, {}, JPEG))
            until(lambda: receiver.requests, lambda: sink.write(TrackedFrame([FOUND])))
    picture = {"frame": 7, "width": 640, "height": 480, "jpeg": b64encode(JPEG).decode()}
    assert [body["picture"] for body in receiver.bodies] == [picture, picture]


def test_event_without_a_picture_is_sent_after_a_time_limit(receiver, endpoint, monkeypatch, until):
    monkeypatch.setattr(remote, "_PICTURE_SECONDS", 0.1)
    files = RunFiles(Origin(options=SinkOptions(picture=True)), None, [f"http://127.0.0.1:{receiver.port}"])
    with files.opened(str(endpoint)) as outputs:
        outputs.write(TrackedFrame([FOUND]))
        until(lambda: receiver.requests, outputs.idle)
    assert [body["picture"] for body in receiver.bodies] == [None, None]


def test_retry_after_is_respected_within_bounds(receiver, monkeypatch, until):
    pauses = []

    class Pause(Event):
        def wait(self, timeout):
            pauses.append(timeout)
            return False

    monkeypatch.setattr(webhook, "Flag", Pause)
    receiver.answers += [(503, "120"), (503, "Fri, 31 Dec 9999 23:59:59 GMT"), (429, "1e9"), (503, "soon"), (500,)]
    with sending(receiver.port):
        until(lambda: len(receiver.requests) == 6)
    assert pauses[:2] == [120, 600]
    assert max(pauses[2:]) < 1


def test_problem_is_logged_once_until_the_destination_has_recovered(monkeypatch, caplog):
    warnings = remote.Warnings("mqtt://me:secret@host/yard")
    for _ in range(9):
        for problem in ("refused", "connection lost"):
            warnings.failed(problem)
        warnings.working()
    monkeypatch.setattr(remote, "_STABLE_SECONDS", 0.0)
    for _ in range(2):
        warnings.working()
    warnings.failed("refused")
    assert [record.getMessage() for record in caplog.records] == [
        f"mqtt://host/yard: {line}" for line in ("refused", "connection lost", "recovered", "refused")
    ]


def test_receiver_that_was_away_gets_all_events_in_order(caplog, until, monkeypatch):
    monkeypatch.setattr(remote, "_STABLE_SECONDS", 0.0)
    with closing(Receiver()) as gone:
        port = gone.port
    with sending(port, "T0/secret") as sink:
        until(lambda: f"http://127.0.0.1:{port}/...: no answer" in caplog.text)
        lose(sink, 1)
        back = Receiver(port)
        until(lambda: "recovered" in caplog.text, lambda: sink.write(TrackedFrame([])))
    back.close()
    assert (back.events, sink.missed) == (ALL, 0)
    assert len(caplog.messages) == 2


@pytest.mark.parametrize(
    ("answers", "expected", "missed"),
    [
        ([503, 429, 200], [ALL[0]] * 3 + ALL[1:], 0),
        ([404, 301], ALL, 2),
        ([200, 500, 410], [ALL[0], ALL[1], *ALL[1:]], 1),
    ],
)
def test_event_is_repeated_after_a_temporary_failure_only(receiver, caplog, answers, expected, missed):
    receiver.answers += [(status,) for status in answers]
    with sending(receiver.port) as sink:
        lose(sink, 1)
    assert receiver.events == expected
    assert sink.missed == missed
    assert (f"{missed} event" in caplog.text) == bool(missed)
    assert len({body["id"] for body in receiver.bodies}) == len(ALL)


def test_slow_receiver_blocks_nothing_and_dropped_events_are_counted(receiver, monkeypatch, caplog, until):
    monkeypatch.setattr(webhook, "QUEUED", 2)
    receiver.holds.clear()
    with sending(receiver.port) as sink:
        until(lambda: sink._bodies.empty())  # the first one is on its way
        lose(sink, 1, 2, 3)
        assert (receiver.requests, sink.missed) == ([], 4)
        receiver.holds.set()
        until(lambda: len(receiver.requests) == 3)
    assert receiver.events == [*ALL[:3], ("ended", 31.0)]
    assert "4 events of 8 were not delivered" in caplog.text


def test_missing_or_empty_key_is_an_error_before_the_run(tmp_path):
    (tmp_path / "empty").write_text(" \n")
    for name, words in (("none", "No such file"), ("empty", "is empty: write the key")):
        with pytest.raises(VideoError, match=rf"{tmp_path}/{name}.*{words}"):
            check_sink("http://host/hook", SinkOptions(secret_file=tmp_path / name))
