"""Live sources return the newest frame, count skipped frames, and reconnect."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import cv2
import pytest

from catstream.base.addresses import without_password
from catstream.errors import VideoError
from catstream.video import connection, live
from catstream.video.source import open_source
from tests.video.pictures import make_video, number_of, numbered, write_video


@pytest.fixture
def served():
    """Serves a folder, or what a function sends for each request: the address of the server."""
    servers: list[ThreadingHTTPServer] = []

    def serve(content):
        class Handler(SimpleHTTPRequestHandler):
            def do_GET(self):
                with suppress(OSError):
                    content(self) if callable(content) else super().do_GET()

            def log_message(self, *_):
                pass

        servers.append(
            ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=None if callable(content) else content))
        )
        servers[-1].daemon_threads = True
        threading.Thread(target=servers[-1].serve_forever, args=(0.02,), daemon=True).start()
        return f"http://127.0.0.1:{servers[-1].server_port}"

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()


def test_every_frame_is_returned_or_counted_as_skipped(camera, until):
    cam, seen = camera(numbered), []
    with open_source(cam.url) as source:
        for frame in source:
            seen.append(number_of(frame.image))
            if len(seen) == 5:
                break
            skipped = source.counters["skipped"]
            until(lambda: source.counters["skipped"] >= skipped + 3)  # noqa: B023
        cam.sends.clear()
        while seen[-1] < (sent := cam.sent) - 1:
            seen.append(number_of(next(source).image))
        assert sent <= len(seen) + source.counters["skipped"] <= cam.sent  # one more may be on its way
    assert seen == sorted(set(seen))
    assert len(seen) < cam.sent / 2


@pytest.mark.parametrize(("ago", "rate"), [(None, None), (1000, 12.5)])
def test_frames_are_numbered_from_the_start_and_timed(camera, ago, rate):
    since = None if ago is None else time.monotonic() - ago
    address = camera(numbered).url.replace("//", "//me:sec[ret@")  # FFmpeg accepts a bracket in a password
    with open_source(address, start=7, since=since, rate=rate) as source:
        assert (source.name, source.frames, source.size, source.live) == ("one", None, (160, 120), True)
        frames = [next(source) for _ in range(10)]
        assert source.rate == (rate or pytest.approx(source.rate))
    assert [frame.number for frame in frames] == list(range(7, 17))
    times = [frame.time for frame in frames]
    assert times == sorted(times)
    assert times[0] == 0 if ago is None else times[0] >= ago


def test_restarted_camera_is_reconnected_and_scaled(camera, until):
    cam = camera(numbered)
    with open_source(cam.url) as source:
        next(source)
        cam.leave()
        until(lambda: source.counters["lost_seconds"] > 0)
        before = source.counters["reconnects"]
        camera(lambda number: numbered(number, 320, 240), cam.port)
        frames = [next(source) for _ in range(3)]
        until(lambda: source.counters["reconnects"] > before)
        until(lambda: source.counters["lost_seconds"] == 0)
    assert [frame.number for frame in frames] == [1, 2, 3]
    assert {frame.image.shape for frame in frames} == {(120, 160, 3)}, "the size of the first frame"


def test_outage_is_logged_once_and_ends_with_a_frame(monkeypatch, caplog):
    now = 100.0
    monkeypatch.setattr(live, "monotonic", lambda: now)
    outages = live.Outages("gate", is_open=True)
    assert outages.lost_seconds(60) is None, "neither a frame nor a failure"
    for now in (101.0, 102.0, 103.0):
        outages.begin("it is unplugged", now)
    assert outages.lost_seconds(60) == 3
    outages.end(now)
    assert (outages.lost_seconds(60), outages.reconnects) == (0, 1)
    lost, reconnected = caplog.messages
    assert (lost, reconnected[-11:]) == ("lost source gate (it is unplugged); reconnecting", "after 3.0 s")
    now += 61
    assert outages.lost_seconds(60) == 61, "silent for longer than the limit"


def test_silent_camera_is_reconnected(camera, caplog, until):
    cam = camera(numbered)
    with open_source(cam.url, read_timeout_seconds=0.5) as source:
        next(source)
        cam.sends.clear()
        until(lambda: source.counters["lost_seconds"] > 0.5)
        cam.sends.set()
        until(lambda: source.counters["reconnects"] >= 1)
        next(source)
    assert "lost source one (no data: check the camera" in caplog.text
    assert "reconnected to source one after" in caplog.text


def test_unreachable_stream_is_an_error_without_its_password(camera, caplog):
    cam = camera(numbered)
    cam.leave()
    with pytest.raises(VideoError, match=r"cannot open 'http://127.*connection refused.*check") as error:
        open_source(cam.url.replace("//", "//me:secr@t@"))
    assert "secr" not in str(error.value)
    assert not caplog.records, "a first failure is an error, not a loss"


def test_camera_that_is_silent_at_the_start_is_an_error(camera):
    cam = camera(numbered)
    cam.sends.clear()
    with pytest.raises(VideoError, match=r"\(no data\): check the camera; if it is slow, raise run\."):
        open_source(cam.url, open_timeout_seconds=1)


def test_missing_camera_is_an_error():
    with pytest.raises(VideoError, match=r"no such file.*\./987$"):
        open_source("987")


@pytest.mark.parametrize(
    ("seconds", "dropped_share", "late"), [(0.03, (0, 0), 0.1), (0.08, (0.4, 0.7), 2.1), (0.5, (0.9, 0.97), 2.6)]
)
def test_slowly_decoded_stream_drops_packets_up_to_a_keyframe(seconds, dropped_share, late):
    backlog, moment, dropped, ages, broken = connection.Backlog(), 0.0, 0, [], False
    for number in range(3000):  # two minutes, with a key frame every second
        moment, is_key = max(moment, number / 25), number % 25 == 0
        if backlog.drops(moment, number / 25, is_key=is_key):
            dropped, broken = dropped + 1, True
            continue
        assert is_key or not broken, "a frame refers to the one before"
        broken, moment = False, moment + seconds
        backlog.is_decoded(moment)
        ages.append(moment - number / 25)
    low, high = dropped_share
    assert low <= dropped / 3000 <= high
    assert max(ages) <= late


def test_packets_delayed_by_the_network_are_not_dropped():
    backlog, moment = connection.Backlog(), 0.0
    for number in range(1000):
        moment = max(moment, number / 25, 23.0 if number >= 510 else 0.0)  # 2.6 s late
        assert not backlog.drops(moment, number / 25, is_key=number % 250 == 0)
        moment += 0.005
        backlog.is_decoded(moment)


def test_idle_function_is_called_until_the_first_frame(camera, until):
    cam, answers = camera(numbered), iter([False, True])
    cam.sends.clear()
    with open_source(cam.url, idle=lambda: next(answers, False)) as source:
        assert "lost_seconds" not in source.counters, "neither a frame nor a failure"
        assert list(source) == []
        cam.leave()
        until(lambda: source.counters.get("lost_seconds", 0) > 0)
        camera(numbered, cam.port)
        assert next(source).number == 0
        assert source.size == (160, 120)


def test_closed_source_has_no_frames_and_no_thread(camera):
    source = open_source(camera(numbered).url)
    source.close()
    assert list(source) == []
    assert not [thread for thread in threading.enumerate() if thread.name == "reader of one"]


@pytest.mark.parametrize("name", ["walk.mp4", "walk.h264"])
def test_url_of_a_video_file_is_an_error(tmp_path, served, name):
    make_video(tmp_path / name, 50, {"movflags": "faststart"} if name.endswith("mp4") else None)
    with pytest.raises(VideoError, match=r"\(a recording\): download it, and pass the file$"):
        open_source(f"{served(tmp_path)}/{name}")


def jpeg(number: int) -> bytes:
    return cv2.imencode(".jpg", numbered(number))[1].tobytes()


#: Parts of MJPEG, with {size} and {jpeg}, as cameras send them.
PARTS = {
    "standard": b"--b\r\nContent-Type: image/jpeg\r\nContent-Length: %(size)d\r\n\r\n%(jpeg)b\r\n",
    "image/jpg": b"--b\r\nContent-Type: image/jpg\r\nContent-Length: %(size)d\r\n\r\n%(jpeg)b\r\n",
    "a parameter": b"--b\r\nContent-Type: image/jpeg; size=1\r\nContent-Length: %(size)d\r\n\r\n%(jpeg)b\r\n",
    "no type": b"--b\r\nContent-Length: %(size)d\r\n\r\n%(jpeg)b\r\n",
    "no headers": b"--b\r\n\r\n%(jpeg)b\r\n",
    "no first boundary": b"Content-Type: image/jpeg\r\nContent-Length: %(size)d\r\n\r\n%(jpeg)b\r\n--b\r\n",
    "text parts": b"--b\r\nContent-Type: text/plain\r\n\r\nhi\r\n--b\r\nContent-Type: image/jpeg\r\n\r\n%(jpeg)b\r\n",
    "LF, no length": b"--b\nContent-Type: image/jpeg\n\n%(jpeg)b\n",
    "JPEGs alone": b"%(jpeg)b",
}


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
def test_mjpeg_is_read_with_any_headers_of_its_parts(served, caplog, part):
    def send(request):
        request.send_response(200)
        request.send_header("Content-Type", 'multipart/x-mixed-replace; boundary="b"')
        request.end_headers()
        for number in range(4000):
            request.wfile.write(part % {b"size": len(jpeg(number)), b"jpeg": jpeg(number)})
            time.sleep(0.02)

    with open_source(f"{served(send)}/video", open_timeout_seconds=4, read_timeout_seconds=2) as source:
        seen = [number_of(next(source).image) for _ in range(20)]
    assert seen == sorted(set(seen))
    assert not caplog.records


@pytest.mark.parametrize("states_length", [True, False])
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_still_picture_is_polled(served, caplog, suffix, states_length, monkeypatch):
    monkeypatch.setattr(live, "_POLL_SECONDS", 0.05)
    fetched = []

    def send(request):
        fetched.append(1)
        picture = cv2.imencode(suffix, numbered(len(fetched), 640))[1].tobytes()
        request.send_response(200)
        if states_length:  # as most cameras do
            request.send_header("Content-Length", str(len(picture)))
        request.end_headers()
        request.wfile.write(picture)

    with open_source(f"{served(send)}/now{suffix}") as source:
        seen = [number_of(next(source).image) for _ in range(5)]
        assert (source.counters["reconnects"], source.counters["lost_seconds"]) == (0, 0)
    assert seen == sorted(set(seen))
    assert not caplog.records


def test_hls_is_returned_at_its_pace_without_repetition(tmp_path, served, monkeypatch, caplog):
    options = {"hls_time": "1", "hls_list_size": "0", "hls_flags": "omit_endlist", "v:g": "25", "v:tune": "zerolatency"}
    write_video(tmp_path / "live.m3u8", 75, (*options.items(),))
    monkeypatch.setattr(connection, "LONGEST_SEGMENT", 0.2)
    url, is_over = f"{served(tmp_path)}/live.m3u8", lambda: source.counters.get("lost_seconds", 0) > 2
    with open_source(url, idle=is_over, read_timeout_seconds=0.3) as source:  # it reconnects after its last segment
        times = [frame.pts for frame in source]
    assert len(times) > 25, "a segment is not skipped"
    assert times == sorted(set(times))
    assert caplog.text.count("lost source") == 1


ADDRESSES = [
    "RTSP://admin:SeCrEt@127.0.0.1:1/x",
    "rtsp:/admin:SeCrEt@127.0.0.1:1/x",
    "admin:SeCrEt@127.0.0.1:1/x",
    "rtsp://admin:Se@Cr/SeCrEt@127.0.0.1:1/x",
    "rtsp://admin:Se?a=SeCrEt@127.0.0.1:1/x",
    "rtsp://admin%3ASeCrEt%40127.0.0.1:1/x",
    "rtsp://127.0.0.1:1/user=admin_password=SeCrEt_channel=1.sdp",
    "http://127.0.0.1:1/video.cgi?user=admin&pwd=SeCrEt",
    "http://127.0.0.1:1/x;token=SeCrEt",
    "http://127.0.0.1:1/token/SeCrEt/x",
    "http://127.0.0.1:1/x#SeCrEt",
]


@pytest.mark.parametrize("address", ADDRESSES)
def test_messages_and_names_contain_no_password(address):
    with pytest.raises(VideoError) as error:
        open_source(address)
    assert "SeCrEt" not in f"{error.value} {without_password(address)} {live._name(address)}"
    assert without_password(without_password(address)) == without_password(address)
