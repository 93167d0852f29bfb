"""Publishes events and the state of each object to an MQTT broker, with discovery by Home Assistant.

    TOPIC/availability     "online"; "offline" at the end, and as last will if the connection breaks; retained
    TOPIC/source           "online", or "lost" while the source is lost; retained
    TOPIC/events           each event, by `EventStream.to_json`
    TOPIC/objects/NAME     the newest track of an object, with `present`, `zones` and `sent`, at the option `rate`, and
                           at each change of `present` or `zones`; retained, and removed when the object ends. While the
                           source is lost, `present` is null. NAME is "-" for the object without a name
    homeassistant/binary_sensor/catstream/ID/config     a sensor for each object, and for each object in each zone

All have QoS 1. While the broker is unreachable, events are queued, and states are dropped, because newer ones replace
them.
"""

from __future__ import annotations

import json
import ssl
import sys
import time
from collections.abc import Iterable
from enum import Enum, auto
from hashlib import blake2b
from typing import Any
from urllib.parse import SplitResult, unquote

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.output.destinations import Origin, Sink, SinkOptions, TrackedFrame, redacted
from catstream.output.events import Event
from catstream.output.remote import CLOSE_SECONDS, QUEUED, EventStream, Warnings, reason_of, split
from catstream.wire.messages import Preview

_LONGEST_PAUSE = 30  # maximum of the exponential backoff between two attempts to connect, in seconds
_KEEPALIVE = 30  # MQTT keepalive in seconds
_REPLY_SECONDS = 10  # timeout for the broker to accept or refuse a connection
_ACCEPT_SECONDS = 1.0  # timeout for earlier messages before the last one is sent
_EXPIRE_SECONDS = 10  # minimum time without a state after which Home Assistant shows a sensor as unavailable
_STATES = "{true: 'ON', false: 'OFF'}"  # in a template of Home Assistant


class _Link(Enum):
    CONNECTING = auto()
    CONNECTED = auto()
    LOST = auto()


class MqttSink(Sink):
    """Publishes from the thread of paho-mqtt; if `QUEUED` messages wait, further ones are dropped.

    missed  number of dropped messages; after `close`, of all messages that the broker has not acknowledged
    """

    def __init__(self, dest: str, origin: Origin) -> None:
        url = _checked(dest)
        self._topic, self._options = unquote(url.path)[1:], origin.options
        self._events, self._warnings = EventStream(origin, has_pictures=origin.options.picture), Warnings(dest)
        self._availability, self._source = f"{self._topic}/availability", f"{self._topic}/source"
        self._source_state = ""  # last published state of the source
        self._deadline = 0.0  # for the delivery, once the sink has ended
        self._sent: dict[str, tuple[object, float]] = {}  # last status of each object, and time of the next one
        self._published = self._acknowledged = self.missed = 0
        self._is_away = False
        self._is_back = False  # whether to publish retained messages again: the broker may have lost them
        self._link, self._attempted = _Link.CONNECTING, time.monotonic()
        self._client = client = Client(CallbackAPIVersion.VERSION2)
        client.max_queued_messages_set(QUEUED)
        client.reconnect_delay_set(1, _LONGEST_PAUSE)
        client.will_set(self._availability, "offline", qos=1, retain=True)
        self._is_tls = url.scheme == "mqtts"
        if self._is_tls:
            client.tls_set_context(ssl.create_default_context())
        if url.username is not None:
            client.username_pw_set(unquote(url.username), unquote(url.password or ""))
        client.on_pre_connect = self._connecting
        client.on_connect, client.on_connect_fail = self._connected, self._not_connected
        client.on_disconnect, client.on_publish = self._disconnected, self._was_published
        client.connect_async(url.hostname or "", url.port or (8883 if self._is_tls else 1883), _KEEPALIVE)
        client.loop_start()
        self._publish(self._availability, "online", retain=True)

    @staticmethod
    def check(dest: str, _: SinkOptions) -> None:
        """Raise VideoError if the address of the broker or the topic is invalid."""
        _checked(dest)

    def write(self, frame: TrackedFrame) -> None:
        """Publish the events of a frame, and states that have changed or whose interval has elapsed."""
        # Step 1: the state of the connection, and retained messages after a reconnection.
        if self._link is _Link.CONNECTED:
            self._warnings.working()
        elif self._link is _Link.CONNECTING and time.monotonic() - self._attempted > _REPLY_SECONDS:
            self._warnings.failed(f"no reply within {_REPLY_SECONDS} s, it may not be an MQTT broker")
        if self._is_back:
            self._is_back, self._source_state = False, ""
            self._publish(self._availability, "online", retain=True)
            for name in self._sent:
                self._announce(name)
                self._sent[name] = None, 0.0
        # Step 2: the state of the source, and events.
        ready, events = self._events.update(frame.tracks), self._events.events
        if (source := "lost" if events.source_lost else "online") != self._source_state:
            self._source_state = source
            self._publish(self._source, source, retain=True)
        self._publish_events(ready)
        # Step 3: the states of the objects.
        now = time.monotonic()
        for track in events.tracks:
            if track.object not in self._sent:
                self._announce(track.object)
            status = events.status(track.object) or {}
            last, next_time = self._sent.get(track.object, (None, now))
            if status != last or (frame.tracks and now >= next_time):
                self._sent[track.object] = status, now + 1 / self._options.rate
                state = {**track.to_dict(), **status, "sent": time.time()}
                if self._is_away:
                    self.missed += 1
                else:
                    self._publish(self._state_topic(track.object), json.dumps(state), retain=True)
        for name in [name for name in self._sent if events.status(name) is None]:
            self._announce(name, ended=True)
            self._remove(name)

    def idle(self) -> None:
        """Publish the events that no longer wait for a picture, and the state of the source."""
        self.write(TrackedFrame(()))

    def end(self) -> None:
        """Publish the last events, and that this program is offline."""
        if self._deadline:
            return
        self._deadline = time.monotonic() + CLOSE_SECONDS
        self._publish_events(self._events.close())
        for name in [*self._sent]:
            self._remove(name)
        # Until the broker accepts the connection, paho sends new messages before queued ones.
        limit = time.monotonic() + _ACCEPT_SECONDS
        while self._acknowledged < self._published and self._link is not _Link.LOST and time.monotonic() < limit:
            time.sleep(0.01)
        self._publish(self._availability, "offline", retain=True)

    def close(self) -> None:
        """Wait for the acknowledgements until the deadline, and warn about missed messages."""
        self.end()
        while self._acknowledged < self._published and time.monotonic() < self._deadline:
            time.sleep(0.02)
        self._client.disconnect()
        if self._acknowledged == self._published:  # otherwise it would wait for the broker; the thread is a daemon
            self._client.loop_stop()
        self.missed += self._published - self._acknowledged
        if self.missed:
            self._warnings.log(f"the broker has not received {counted(self.missed, 'message')}")

    def _publish_events(self, events: Iterable[tuple[Event, Preview | None]]) -> None:
        for event, picture in events:
            self._publish(f"{self._topic}/events", self._events.to_json(event, picture))

    def _publish(self, topic: str, payload: bytes | str, *, retain: bool = False) -> None:
        if self._client.publish(topic, payload, 1, retain).rc == MQTTErrorCode.MQTT_ERR_QUEUE_SIZE:
            self.missed += 1
        else:
            self._published += 1

    def _state_topic(self, name: str) -> str:
        return f"{self._topic}/objects/{name or '-'}"

    def _remove(self, name: str) -> None:
        """Remove the retained state of an object."""
        del self._sent[name]
        self._publish(self._state_topic(name), b"", retain=True)

    def _announce(self, name: str, *, ended: bool = False) -> None:
        """Let Home Assistant create the sensors of an object, or remove them if it has `ended`."""
        state, label = self._state_topic(name), name or "object"
        sensors = {label: "value_json.present"}
        for zone in self._options.zone:
            sensors[f"{label} in {zone}"] = f"value_json.present and '{zone}' in value_json.zones"
        for sensor, condition in sensors.items():
            number = _id(state + condition)
            config = {
                **{"name": sensor, "unique_id": f"catstream_{number}", "device_class": "occupancy"},
                **{"state_topic": state, "json_attributes_topic": state},
                # "None" makes the state unknown
                "value_template": f"{{{{ {_STATES}.get(value_json is defined and {condition}) }}}}",
                "availability": [
                    {"topic": self._availability},
                    {"topic": self._source, "payload_not_available": "lost"},
                ],
                "availability_mode": "all",
                "expire_after": max(_EXPIRE_SECONDS, round(3 / self._options.rate)),
                "device": {"identifiers": [f"catstream_{_id(self._topic)}"], "name": self._topic},
                "origin": {"name": "catstream"},
            }
            topic = f"homeassistant/binary_sensor/catstream/{number}/config"
            self._publish(topic, b"" if ended else json.dumps(config), retain=True)

    # Called by paho, in its thread.

    def _connecting(self, *_: object) -> None:
        self._link, self._attempted = _Link.CONNECTING, time.monotonic()

    def _connected(self, _: Client, __: object, ___: object, reason: Any, ____: object) -> None:
        if reason.is_failure:
            self._lose(f"the broker refuses the connection ({reason})")
        else:
            self._link, self._is_back, self._is_away = _Link.CONNECTED, self._is_away, False

    def _not_connected(self, _: Client, __: object) -> None:
        self._lose(f"no connection ({reason_of(sys.exception())})")

    def _disconnected(self, _: Client, __: object, ___: object, reason: Any, ____: object) -> None:
        if reason.is_failure and self._link is _Link.CONNECTING:
            other = "mqtt:// without TLS" if self._is_tls else "mqtts:// with TLS"
            self._lose(f"no MQTT reply: not an MQTT broker, another port, or {other}")
        elif reason.is_failure and self._link is _Link.CONNECTED:
            self._lose(f"the connection was lost ({reason})")

    def _lose(self, problem: str) -> None:
        self._link, self._is_away = _Link.LOST, True
        self._warnings.failed(f"{problem}; reconnecting")

    def _was_published(self, *_: object) -> None:
        self._acknowledged += 1


def _id(text: str) -> str:
    """A hash of a text in hexadecimal digits, the same in every run."""
    return blake2b(text.encode(), digest_size=8).hexdigest()


def _checked(dest: str) -> SplitResult:
    """Parse the address; VideoError if it is invalid."""
    url = split(dest, "mqtt://[USER:PASSWORD@]HOST[:PORT]/TOPIC")
    if url.path in ("", "/") or set("+#@") & set(unquote(url.path)) or set("?#") & set(dest):
        raise VideoError(f"{redacted(dest)} has no valid topic: expected mqtt://HOST/TOPIC, without any of + # ? @")
    return url
