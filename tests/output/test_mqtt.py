"""MQTT with a real broker that runs, is away, comes back or is silent, and with servers that are no brokers."""

import gc
import json
import os
import re
import shutil
import socket
import ssl
import subprocess
import sys
import threading
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from socketserver import BaseRequestHandler, TCPServer

import paho.mqtt.client as mqtt
import pytest

from catstream.base.box import Box
from catstream.client.address import Address
from catstream.output import mqtt_sink
from catstream.output.destinations import Origin, SinkOptions, TrackedFrame, open_sink
from catstream.wire.channels import HEALTH
from catstream.wire.messages import Health, Track
from catstream.wire.newest import Publisher

MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # by paho
needs_broker = pytest.mark.skipif(MOSQUITTO is None, reason="no MQTT broker: apt-get install mosquitto")
DOOR = {"door": ((0, 0), (100, 0), (100, 100), (0, 100))}
ANNA = Track(0, 0.0, "present", Box(10, 20, 30, 40), 0.9, 1, object="anna")


class Broker:
    """A broker with the user me, whose password is s/1; `start` and `stop` may be called again and again."""

    def __init__(self, folder, until):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self._folder, self._until, self._process, self._stack = folder, until, None, ExitStack()
        self.url = f"mqtt://me:s%2F1@localhost:{self.port}/yard/cam"
        (folder / "passwords").write_text("me:s/1\n")
        (folder / "passwords").chmod(0o600)
        subprocess.run(["mosquitto_passwd", "-U", folder / "passwords"], check=True)
        lines = [f"listener {self.port} localhost", "allow_anonymous false", f"password_file {folder / 'passwords'}"]
        user = "user root" if os.getuid() == 0 else ""
        (folder / "conf").write_text("\n".join([*lines, user, "persistence false", ""]))

    def start(self):
        self._process = subprocess.Popen([MOSQUITTO, "-c", self._folder / "conf"], stderr=subprocess.DEVNULL)
        self._until(self._listens)

    def _listens(self):
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def stop(self):
        self._stack.pop_all().close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def subscriber(self):
        """Return the payloads by topic that a new subscriber receives, the retained ones first."""
        got, subscribed = {}, []
        client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.username_pw_set("me", "s/1")
        client.on_message = lambda _, __, it: got.setdefault(it.topic, []).append(it.payload.decode())
        client.on_subscribe = lambda *_: subscribed.append(True)
        client.connect("localhost", self.port)
        client.loop_start()
        self._stack.callback(client.loop_stop)
        self._stack.callback(client.disconnect)
        client.subscribe("#", 1)
        self._until(lambda: subscribed)
        return got


@pytest.fixture
def broker(tmp_path, until):
    found = Broker(tmp_path, until)
    yield found
    found.stop()


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """Wait at the end for a broker on a busy machine."""
    monkeypatch.setattr(mqtt_sink, "CLOSE_SECONDS", 60.0)


@pytest.fixture
def absent_broker(monkeypatch, until):
    """Do not wait at the end for a broker that stays away; collect the sockets that paho does not close."""
    monkeypatch.setattr(mqtt_sink, "CLOSE_SECONDS", 0.1)
    yield
    until(lambda: not any(thread.name.startswith("paho") for thread in threading.enumerate()))
    gc.collect()


def opened(url, **options):
    return closing(open_sink(url, Origin(options=SinkOptions(**options))))


def online(sink, until):
    """Write a track once there is a connection, and wait until all has arrived."""
    until(lambda: sink._client.is_connected() and not sink._is_away)
    sink.write(TrackedFrame([ANNA]))
    until(lambda: sink._acknowledged == sink._published)


def events(got):
    return [(each["event"], each["time"]) for each in map(json.loads, got.get("yard/cam/events", []))]


def last(got, topic):
    """The newest payload of a topic, or None where it has not arrived yet."""
    return got.get(topic, [None])[-1]


def lost(time):
    return TrackedFrame([replace(ANNA, frame=time, time=float(time), state="absent", box=None)])


@needs_broker
def test_subscriber_receives_events_states_and_availability(broker, until):
    broker.start()
    got = broker.subscriber()
    with opened(broker.url, zone=DOOR, rate=1e-3) as sink:
        online(sink, until)
        late = broker.subscriber()  # receives the retained messages
        until(lambda: len(late) == 5)
        sink.write(lost(9))
    assert sink.missed == 0
    until(lambda: last(got, "yard/cam/availability") == "offline")
    assert got["yard/cam/availability"] == ["online", "offline"]
    assert events(got) == [("found", 0.0), ("entered", 0.0), ("left", 9.0), ("lost", 9.0), ("ended", 9.0)]
    *states, removed = got["yard/cam/objects/anna"]  # only at the changes, with this rate
    assert removed == ""
    assert [(state["present"], state["zones"], state["frame"]) for state in map(json.loads, states)] == [
        (True, ["door"], 0), (False, [], 9),
    ]  # fmt: skip
    assert json.loads(late["yard/cam/objects/anna"][0]) == json.loads(states[0])
    configs = [json.loads(each[0]) for topic, each in late.items() if topic.startswith("homeassistant/")]
    assert {config["name"] for config in configs} == {"anna", "anna in door"}
    for config in configs:
        assert config["state_topic"] in late
        assert {each["topic"] for each in config["availability"]} == {"yard/cam/availability", "yard/cam/source"}


@needs_broker
def test_lost_source_is_an_event_and_its_objects_are_unknown(broker, until, endpoint):
    broker.start()
    got = broker.subscriber()
    with Publisher(HEALTH, endpoint, "detector") as health:
        origin = Origin(address=Address(str(endpoint)), options=SinkOptions(zone=DOOR, rate=1e-3))
        with closing(open_sink(broker.url, origin)) as sink:
            online(sink, until)

            def report(seconds, state):
                def turn():
                    for counters in ({"lost_seconds": seconds}, {}):  # a restarted detector does not know it yet
                        health.send(Health("detector", 0.0, counters, source="rtsp://cam"))
                    sink.idle()

                until(lambda: last(got, "yard/cam/source") == state, turn)

            report(7.0, "lost")
            report(0.0, "online")
            online(sink, until)
    until(lambda: last(got, "yard/cam/availability") == "offline")
    assert got["yard/cam/source"] == ["online", "lost", "online"]
    about = [each for each in map(json.loads, got["yard/cam/events"]) if each["track"] is None]
    assert [(each["event"], each["source"], each["seconds"]) for each in about] == [
        ("source_lost", "rtsp://cam", 7.0), ("source_back", "rtsp://cam", 7.0),
    ]  # fmt: skip
    states = [json.loads(each) for each in got["yard/cam/objects/anna"] if each]
    assert [(state["present"], state["zones"]) for state in states] == [(True, ["door"]), (None, []), (True, ["door"])]
    jinja2 = pytest.importorskip("jinja2")  # the templates of Home Assistant
    configs = [json.loads(each[0]) for topic, each in got.items() if topic.startswith("homeassistant/")]
    for config in configs:
        template = jinja2.Template(config["value_template"])
        assert [template.render(value_json=state) for state in states] == ["ON", "None", "ON"]
        assert template.render(value_json={"present": False, "zones": []}) == template.render() == "OFF"


@needs_broker
def test_sensors_of_a_forgotten_object_are_removed(broker, until):
    broker.start()
    got = broker.subscriber()
    with opened(broker.url, when={"lost": 2.0}) as sink:
        online(sink, until)
        for frame in range(1, 5):
            sink.write(TrackedFrame([replace(ANNA, frame=frame, object="ben")]))
        until(lambda: last(got, "yard/cam/objects/anna") == "")
        empty = [topic for topic, each in got.items() if each[-1] == "" and topic.startswith("homeassistant/")]
        assert [json.loads(got[topic][0])["name"] for topic in empty] == ["anna"]


@needs_broker
def test_killed_process_is_offline_by_its_last_will(broker, until):
    broker.start()
    got = broker.subscriber()
    killed = (
        "import os, sys, time; from catstream.output.destinations import *; from catstream.wire.messages import *\n"
        "sink = open_sink(sys.argv[1], Origin())\n"
        "while sink._acknowledged < 5:\n"
        "    sink.write(TrackedFrame([Track(0, 0.0, 'absent', None, 0.0, 0)])); time.sleep(0.01)\n"
        "os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-P", "-c", killed, broker.url], check=False)
    until(lambda: got.get("yard/cam/availability") == ["online", "offline"])
    assert "yard/cam/objects/-" in got


@needs_broker
def test_broker_that_is_back_gets_all_events_but_not_all_states(broker, until, caplog):
    with opened(broker.url, rate=1e6) as sink:
        sink.write(TrackedFrame([ANNA]))
        until(lambda: "no connection (Connection refused)" in caplog.text)
        sink.write(TrackedFrame([ANNA]))
        broker.start()
        got = broker.subscriber()
        online(sink, until)
        until(lambda: events(got) == [("found", 0.0)])
        assert sink.missed > 0
        until(lambda: sink._acknowledged == sink._published)
        broker.stop()  # it loses the retained messages
        until(lambda: "the connection was lost" in caplog.text)
        sink.write(lost(9))
        broker.start()
        got = broker.subscriber()
        online(sink, until)
    until(lambda: last(got, "yard/cam/availability") == "offline")
    assert ("lost", 9.0) in events(got)
    assert events(got)[-1] == ("ended", 0.0)
    assert got["yard/cam/availability"] == ["online", "offline"]
    assert any(topic.startswith("homeassistant/") for topic in got)
    assert f"the broker has not received {sink.missed} message" in caplog.text
    assert re.search("s(/|%2F)1", caplog.text) is None


@pytest.mark.usefixtures("absent_broker")
def test_silent_broker_blocks_nothing_and_misses_are_counted(monkeypatch, caplog):
    monkeypatch.setattr(mqtt_sink, "QUEUED", 5)
    monkeypatch.setattr(mqtt_sink, "_REPLY_SECONDS", 0)
    with (
        socket.create_server(("127.0.0.1", 0)) as silent,
        opened(f"mqtt://127.0.0.1:{silent.getsockname()[1]}/yard", rate=1e-3) as sink,
    ):
        sink.write(TrackedFrame([ANNA]))
        for time in range(1, 21):
            sink.write(lost(10 * time))
            sink.write(TrackedFrame([replace(ANNA, frame=10 * time + 1, time=10.0 * time + 1)]))
    # 42 events: found, 20 lost, 20 returned, ended; a state after all but the last; online and offline, the state of
    # the source, sensor, removal
    assert sink.missed == 42 + 41 + 5
    assert "it may not be an MQTT broker" in caplog.text
    assert "the broker has not received 88 messages" in caplog.text


@contextmanager
def answering(reply, tls=None):
    """A server that answers each connection with some bytes, and closes it; yields its port, and the connections."""

    class Handler(BaseRequestHandler):
        def handle(self):
            with suppress(OSError):
                connection = tls.wrap_socket(self.request, server_side=True) if tls else self.request
                connections.append(connection.recv(1024))  # all: a reply before a reset would be lost
                connection.sendall(reply)

    connections = []
    with TCPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server.server_address[1], connections
        server.shutdown()


HTTP = b"HTTP/1.1 400 Bad Request\r\n\r\n"
REFUSED = b"\x20\x02\x00\x05"  # an acknowledgement of MQTT 3.1.1: not authorized


@pytest.mark.usefixtures("absent_broker")
@pytest.mark.parametrize(
    ("scheme", "reply", "problem"),
    [
        ("mqtt", b"", "no MQTT reply: not an MQTT broker, another port, or mqtts:// with TLS"),
        ("mqtt", HTTP, "no MQTT reply: not an MQTT broker"),
        ("mqtts", HTTP, "TLS handshake failed, the port may be one without TLS"),
        ("mqtt", REFUSED, "the broker refuses the connection (Not authorized)"),
    ],
)
def test_server_that_is_no_broker_or_refuses_is_logged_once(scheme, reply, problem, until, caplog, monkeypatch):
    monkeypatch.setattr(mqtt_sink, "_LONGEST_PAUSE", 1)
    with answering(reply) as (port, connections), opened(f"{scheme}://127.0.0.1:{port}/yard") as sink:
        until(lambda: len(connections) >= 3)
        sink.write(TrackedFrame([ANNA]))
    (message,) = [message for message in caplog.messages if "has not received" not in message]
    assert problem in message


@pytest.mark.usefixtures("absent_broker")
@pytest.mark.skipif(shutil.which("openssl") is None, reason="no certificate without it: apt-get install openssl")
def test_tls_connects_only_to_a_server_with_a_trusted_certificate(tmp_path, until, monkeypatch, caplog):
    words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=DNS:localhost"
    files = ["-keyout", tmp_path / "key", "-out", tmp_path / "crt"]
    subprocess.run(["openssl", *words.split(), *files], capture_output=True, check=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "crt", tmp_path / "key")
    with answering(REFUSED, context) as (port, connections):
        with opened(f"mqtts://localhost:{port}/yard"):
            until(lambda: "certificate verify failed" in caplog.text)
        assert not connections
        monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "crt"))
        with opened(f"mqtts://localhost:{port}/yard"):
            until(lambda: connections)
