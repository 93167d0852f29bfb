"""A webhook: posts each event as JSON to a URL.

The body is from `EventStream.to_json`. With a key, the header `X-Catstream-Signature` is `sha256=` and the HMAC-SHA256
of the body in hexadecimal digits. After status 408, 425, 429 or 5xx, or without a response, the event is sent again
with the same `id`, not before `Retry-After`, while later events wait. After any other status than 2xx, it is dropped.
"""

from __future__ import annotations

import hmac
import time
from base64 import b64encode
from collections.abc import Iterable
from contextlib import suppress
from email.utils import parsedate_to_datetime
from http.client import HTTPConnection, HTTPException, HTTPSConnection, responses
from queue import SimpleQueue
from threading import Event as Flag
from threading import Thread
from urllib.parse import unquote, urlunsplit

from catstream.base.text import counted
from catstream.errors import VideoError
from catstream.output.destinations import Origin, Sink, SinkOptions, TrackedFrame
from catstream.output.events import Event
from catstream.output.remote import CLOSE_SECONDS, QUEUED, EventStream, Warnings, reason_of, split
from catstream.wire.messages import Preview

_FORM = "https://[USER:PASSWORD@]HOST[:PORT]/PATH"
_TIMEOUT = 10.0  # seconds for a connection, and for a response
_PAUSE, _LONGEST_PAUSE = 1.0, 60.0  # exponential backoff in seconds: first and longest pause before a retry
_LONGEST_RETRY_AFTER = 600.0  # maximum accepted Retry-After in seconds
_AGAIN = {0, 408, 425, 429, *range(500, 600)}  # status codes that are retried; 0 for no response


class Webhook(Sink):
    """Posts the events from a background thread; if `QUEUED` events wait, further ones are dropped.

    missed  number of dropped events; after `close`, of all events that were not delivered
    """

    def __init__(self, dest: str, origin: Origin) -> None:
        self._url, self._key = split(dest, _FORM), _key(origin.options)
        self._events, self._warnings = EventStream(origin, has_pictures=origin.options.picture), Warnings(dest)
        self._bodies: SimpleQueue[bytes | None] = SimpleQueue()
        self._count = self._delivered = self.missed = 0
        self._hurry, self._closed = Flag(), False  # `_hurry` interrupts a pause
        self._deadline: float | None = None  # for the delivery, once the sink has ended
        self._retry_after, self._is_working = 0.0, False  # by the last response
        self._thread = Thread(target=self._deliver_all, name="webhook", daemon=True)
        self._thread.start()

    @staticmethod
    def check(dest: str, options: SinkOptions) -> None:
        """Raise VideoError if the address is invalid or the key cannot be read."""
        split(dest, _FORM)
        _key(options)

    def write(self, frame: TrackedFrame) -> None:
        """Queue the events of a frame."""
        if self._is_working:
            self._warnings.working()
        self._queue(self._events.update(frame.tracks))

    def idle(self) -> None:
        """Queue the events that no longer wait for a picture."""
        self._queue(self._events.update())

    def end(self) -> float:
        """Queue the last events; return the deadline for the delivery of the backlog."""
        if self._deadline is None:
            self._deadline = time.monotonic() + CLOSE_SECONDS
            self._queue(self._events.close())
            self._bodies.put(None)
            self._hurry.set()
        return self._deadline

    def close(self) -> None:
        """Wait for the delivery of the backlog until the deadline, and warn about missed events."""
        self._thread.join(max(0.0, self.end() - time.monotonic()))
        self._closed = True
        self._hurry.set()
        self.missed = self._count - self._delivered
        if self.missed:
            self._warnings.log(f"{counted(self.missed, 'event')} of {self._count} were not delivered")

    def _queue(self, events: Iterable[tuple[Event, Preview | None]]) -> None:
        for event, picture in events:
            self._count += 1
            if self._bodies.qsize() < QUEUED:
                self._bodies.put(self._events.to_json(event, picture))
            else:
                self.missed += 1

    def _deliver_all(self) -> None:
        """Deliver the events in order, until all were delivered or the sink is closed."""
        for body in iter(self._bodies.get, None):
            pause = _PAUSE
            while (status := self._post(body)) in _AGAIN:
                if self._closed:
                    return
                is_closing = self._hurry.wait(max(pause, self._retry_after))
                pause = _PAUSE if is_closing else min(2 * pause, _LONGEST_PAUSE)
                self._hurry.clear()
            self._delivered += status // 100 == 2

    def _post(self, body: bytes) -> int:
        """Post an event; return the status of the response, 0 without a response."""
        url, headers = self._url, {"Content-Type": "application/json", "User-Agent": "catstream"}
        if url.username is not None:
            user = f"{unquote(url.username)}:{unquote(url.password or '')}"
            headers["Authorization"] = f"Basic {b64encode(user.encode()).decode()}"
        if self._key:
            headers["X-Catstream-Signature"] = f"sha256={hmac.digest(self._key, body, 'sha256').hex()}"
        kind = HTTPSConnection if url.scheme == "https" else HTTPConnection
        connection = kind(url.hostname or "", url.port, timeout=_TIMEOUT)
        status, problem = 0, ""
        try:
            connection.request("POST", urlunsplit(("", "", url.path or "/", url.query, "")), body, headers)
            response = connection.getresponse()
            status, self._retry_after = response.status, _seconds(response.getheader("Retry-After", ""))
            if status // 100 != 2:
                problem = f"answered {status} {responses.get(status, '')}"
        except OSError as error:
            self._retry_after, problem = 0.0, f"no answer ({reason_of(error)})"
        except HTTPException:
            self._retry_after, problem = 0.0, "the answer is not HTTP"
        finally:
            connection.close()
        self._is_working = not problem
        if problem:
            retried = status in _AGAIN
            self._warnings.failed(f"{problem}; {'retrying' if retried else 'the event is not sent again'}")
        return status


def _seconds(retry_after: str) -> float:
    """Parse a header `Retry-After`, a number of seconds or a date, to seconds from now; 0 if it is invalid.

    >>> _seconds("120"), _seconds("Fri, 31 Dec 9999 23:59:59 GMT"), _seconds("soon")
    (120.0, 600.0, 0.0)
    """
    seconds = 0.0
    with suppress(ValueError, OverflowError):
        is_number = retry_after.strip().isdecimal()
        seconds = float(retry_after) if is_number else parsedate_to_datetime(retry_after).timestamp() - time.time()
    return min(max(seconds, 0.0), _LONGEST_RETRY_AFTER)


def _key(options: SinkOptions) -> bytes:
    """Return the key for signatures; empty without one."""
    if options.secret_file is None:
        return b""
    try:
        key = options.secret_file.read_bytes().strip()
    except OSError as error:
        raise VideoError(f"cannot read the key {options.secret_file}: {error.strerror}") from None
    if not key:
        raise VideoError(f"{options.secret_file} is empty: write the key of the receiver to it")
    return key
