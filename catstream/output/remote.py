"""Shared by the destinations on the network: events as JSON, warnings, and the check of an address."""

from __future__ import annotations

import json
import logging
import ssl
import time
from base64 import b64encode
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from urllib.parse import SplitResult, urlsplit
from uuid import uuid4

from catstream.client.attach import subscribe
from catstream.client.subscription import Subscription
from catstream.errors import SilenceError, VideoError
from catstream.output.destinations import Origin, redacted
from catstream.output.events import Event, Events
from catstream.wire.messages import Health, Preview, Track

#: Messages that wait for a destination that is away or slow; further ones are dropped.
QUEUED = 256

#: Seconds at the end of a run in which the backlog is sent, or written to a locked database.
CLOSE_SECONDS = 5.0

_STABLE_SECONDS = 10.0  # without a failure, after which a destination has recovered
_REPORT_SECONDS = 0.5  # between two looks for a health report; a process sends one a second
_PICTURE_SECONDS = 2.0  # that an event waits for a picture of its frame

_log = logging.getLogger(__name__)


class Warnings:
    """Warns about a destination, whose address is logged without its password.

    Hysteresis: each problem is logged once, until the destination has worked for `_STABLE_SECONDS` without a failure.
    So a receiver that alternates between two failures, or accepts and closes each connection, does not fill the log.
    """

    def __init__(self, dest: str) -> None:
        self._address = redacted(dest)
        self.problems: dict[str, None] = {}  #: since it has worked, in order
        self._working_since: float | None = None

    def failed(self, problem: str) -> None:
        """Log a problem of the destination; its text has no part that changes from one attempt to the next."""
        self._working_since = None
        if problem not in self.problems:
            self.problems[problem] = None
            self.log(problem)

    def working(self) -> None:
        """Note that the destination works; is called again and again while it does."""
        now = time.monotonic()
        since = self._working_since = self._working_since or now
        if self.problems and now - since >= _STABLE_SECONDS:
            self.problems.clear()
            self.log("recovered")

    def log(self, text: str) -> None:
        _log.warning("%s: %s", self._address, text)


class EventStream:
    """Detects events, each with a picture if that is wanted: the first one of the frame of the event or a later one.

    If none arrives within `_PICTURE_SECONDS`, an event has the newest picture, None if there is none, as at once an
    event of the run, which is detected in the health reports. Without pictures, events do not wait.
    """

    def __init__(self, origin: Origin, *, has_pictures: bool) -> None:
        self.events = Events(origin.options.zone, origin.options.when)
        self._waiting: deque[tuple[Event, float]] = deque()  # with the times up to which they wait
        self._newest: Preview | None = None
        self._previews: Subscription[Preview] | None = None
        self._reports: Subscription[Health] | None = None
        self._next_look = 0.0
        if str(origin.address):
            self._reports = subscribe(origin.address, "health", timeout=0)
        if has_pictures:
            self._previews = subscribe(origin.address, "previews", timeout=0)

    def update(self, tracks: Sequence[Track] = ()) -> list[tuple[Event, Preview | None]]:
        """Return the events of further tracks, and those that have waited, with their pictures.

        Call it without tracks while no frame arrives, so that their wait ends in time.
        """
        now = time.monotonic()
        events = self.events.update(tracks)
        if now >= self._next_look:
            self._next_look = now + _REPORT_SECONDS
            with suppress(SilenceError):  # no further report has arrived
                for report in self._reports or ():
                    events += self.events.update_run(report)
        self._waiting += [(event, now + _PICTURE_SECONDS) for event in events]
        with suppress(SilenceError):  # no further picture has arrived
            for preview in self._previews or ():
                self._newest = preview
        ready = []
        while self._waiting:
            event, due = self._waiting[0]
            is_early = event.track is not None and (self._newest is None or self._newest.frame < event.track.frame)
            if self._previews is not None and is_early and now < due:
                break
            ready.append((self._waiting.popleft()[0], self._newest))
        return ready

    def close(self) -> list[tuple[Event, Preview | None]]:
        """Return the last events; none if it is closed already."""
        for subscription in (self._previews, self._reports):
            if subscription is not None:
                subscription.close()
        events = [*(event for event, _ in self._waiting), *self.events.close()]
        self._waiting.clear()
        return [(event, self._newest) for event in events]

    def to_json(self, event: Event, picture: Preview | None) -> bytes:
        """Return a JSON object: `Event.to_dict`, `id`, `sent` in seconds since 1970, and `picture` if that is wanted.

        The picture is the JPEG file in Base64, the number of its frame, and the width and height of a frame, which may
        be larger.
        """
        fields = {"id": uuid4().hex, "sent": time.time(), **event.to_dict()}
        if self._previews is not None:
            fields["picture"] = picture and {
                **{"frame": picture.frame, "width": picture.width, "height": picture.height},
                "jpeg": b64encode(picture.jpeg).decode(),
            }
        return json.dumps(fields).encode()


def split(dest: str, form: str) -> SplitResult:
    """Return the parts of an address; VideoError with its `form` and the defect, without its password."""
    host = dest.partition("://")[2].partition("/")[0]
    wrong = ""
    if not all("!" <= letter <= "~" for letter in dest):
        wrong = "percent-encode spaces and letters outside ASCII, a space is %20"
    elif "@" not in host and "@" in dest:
        wrong = "percent-encode a / in the user name or password, it is %2F"
    else:
        try:
            url = urlsplit(dest)
            if url.port != 0 and url.hostname and url.hostname.encode("idna"):
                return url
            wrong = "the port has to be 1 to 65535" if url.port == 0 else "the host is missing"
        except UnicodeError:
            wrong = "the name of the host is not valid"
        except ValueError:
            wrong = "the port has to be 1 to 65535, an IPv6 address is in brackets"
    raise VideoError(f"invalid address {redacted(dest)} ({wrong}): expected {form}")


def reason_of(error: BaseException | None) -> str:
    """Return why a connection failed, with what to do if the server and the address disagree about TLS."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"certificate verify failed: {error.verify_message}; for a CA of your own, set SSL_CERT_FILE"
    if isinstance(error, ssl.SSLError):
        reason = (error.reason or "no reply").lower().replace("_", " ")
        return f"TLS handshake failed, the port may be one without TLS: {reason}"
    return str(getattr(error, "strerror", None) or error or type(error).__name__)
