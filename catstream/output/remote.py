"""Common parts of the network destinations: events as JSON, warnings, and the check of an address."""

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

#: Length of the queue for a slow or unreachable destination; further messages are dropped.
QUEUED = 256

#: Timeout at the end of a run for sending the backlog, or for writing it to a locked database.
CLOSE_SECONDS = 5.0

_STABLE_SECONDS = 10.0  # time without a failure after which a destination has recovered
_REPORT_SECONDS = 0.5  # polling interval for health reports, which arrive once a second
_PICTURE_SECONDS = 2.0  # timeout of an event for a picture of its frame

_log = logging.getLogger(__name__)


class Warnings:
    """Logs problems of a destination, with its address without the password.

    Hysteresis: each problem is logged once, until the destination has worked for `_STABLE_SECONDS` without a failure.
    A receiver that alternates between two failures, or accepts and closes each connection, does not fill the log.
    """

    def __init__(self, dest: str) -> None:
        self._address = redacted(dest)
        self.problems: dict[str, None] = {}  #: problems since the last recovery, in order
        self._working_since: float | None = None

    def failed(self, problem: str) -> None:
        """Log a problem once. Its text must be the same for each attempt."""
        self._working_since = None
        if problem not in self.problems:
            self.problems[problem] = None
            self.log(problem)

    def working(self) -> None:
        """Record that the destination works; call this repeatedly."""
        now = time.monotonic()
        since = self._working_since = self._working_since or now
        if self.problems and now - since >= _STABLE_SECONDS:
            self.problems.clear()
            self.log("recovered")

    def log(self, text: str) -> None:
        _log.warning("%s: %s", self._address, text)


class EventStream:
    """Detects events and, with pictures, adds the first preview of the event's frame or of a later one.

    After `_PICTURE_SECONDS`, an event has the newest preview, or None. Events of the run, which are detected in the
    health reports, have it at once. Without pictures, events do not wait.
    """

    def __init__(self, origin: Origin, *, has_pictures: bool) -> None:
        self.events = Events(origin.options.zone, origin.options.when)
        self._waiting: deque[tuple[Event, float]] = deque()  # each with its deadline
        self._newest: Preview | None = None
        self._previews: Subscription[Preview] | None = None
        self._reports: Subscription[Health] | None = None
        self._next_look = 0.0
        if str(origin.address):
            self._reports = subscribe(origin.address, "health", timeout=0)
        if has_pictures:
            self._previews = subscribe(origin.address, "previews", timeout=0)

    def update(self, tracks: Sequence[Track] = ()) -> list[tuple[Event, Preview | None]]:
        """Return the events that no longer wait, with their pictures; `tracks` may add events.

        Call it without tracks while no frame arrives, so that deadlines are met.
        """
        now = time.monotonic()
        events = self.events.update(tracks)
        if now >= self._next_look:
            self._next_look = now + _REPORT_SECONDS
            with suppress(SilenceError):  # all reports were read
                for report in self._reports or ():
                    events += self.events.update_run(report)
        self._waiting += [(event, now + _PICTURE_SECONDS) for event in events]
        with suppress(SilenceError):  # all previews were read
            for preview in self._previews or ():
                self._newest = preview
        ready = []
        while self._waiting:
            event, deadline = self._waiting[0]
            is_early = event.track is not None and (self._newest is None or self._newest.frame < event.track.frame)
            if self._previews is not None and is_early and now < deadline:
                break
            ready.append((self._waiting.popleft()[0], self._newest))
        return ready

    def close(self) -> list[tuple[Event, Preview | None]]:
        """Return the last events; empty if it is closed already."""
        for subscription in (self._previews, self._reports):
            if subscription is not None:
                subscription.close()
        events = [*(event for event, _ in self._waiting), *self.events.close()]
        self._waiting.clear()
        return [(event, self._newest) for event in events]

    def to_json(self, event: Event, picture: Preview | None) -> bytes:
        """Return a JSON object: `Event.to_dict`, `id`, `sent` in seconds since 1970, and `picture` if enabled.

        The picture has the JPEG file in Base64, the number of its frame, and the width and height of the frame, which
        may be larger.
        """
        fields = {"id": uuid4().hex, "sent": time.time(), **event.to_dict()}
        if self._previews is not None:
            fields["picture"] = picture and {
                **{"frame": picture.frame, "width": picture.width, "height": picture.height},
                "jpeg": b64encode(picture.jpeg).decode(),
            }
        return json.dumps(fields).encode()


def split(dest: str, form: str) -> SplitResult:
    """Parse an address; VideoError with the defect and the expected `form`, without the password."""
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
    """Return the reason for a failed connection, with a remedy for certificate errors and TLS mismatches."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"certificate verify failed: {error.verify_message}; for a CA of your own, set SSL_CERT_FILE"
    if isinstance(error, ssl.SSLError):
        reason = (error.reason or "no reply").lower().replace("_", " ")
        return f"TLS handshake failed, the port may be one without TLS: {reason}"
    return str(getattr(error, "strerror", None) or error or type(error).__name__)
