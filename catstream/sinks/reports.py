"""What destinations on the network share: the events of a run as JSON, warnings, and the check of their addresses."""

from __future__ import annotations

import json
import logging
import time
from base64 import b64encode
from collections.abc import Sequence
from contextlib import suppress
from urllib.parse import SplitResult, urlsplit
from uuid import uuid4

from catstream.client.subscription import Subscription
from catstream.errors import SilenceError, VideoError
from catstream.messages.kinds import Preview, Track
from catstream.sinks.destinations import Origin, redacted
from catstream.sinks.events import Event, Events

#: Messages that wait for a destination that is away or slow; further ones are missed.
QUEUED = 256

#: Seconds at the end of a run in which what waits is sent.
CLOSE_SECONDS = 5.0

_log = logging.getLogger(__name__)


class Warnings:
    """Warns about a destination, which is shown without its password."""

    def __init__(self, place: str) -> None:
        self._shown, self._problem = redacted(place), ""

    def warn(self, problem: str) -> None:
        """Warn of a problem of the destination, once however often it occurs; with "", say that it is over."""
        if problem != self._problem:
            self._problem = problem
            self.tell(problem or "is back")

    def tell(self, text: str) -> None:
        """Warn of something about the destination."""
        _log.warning("%s: %s", self._shown, text)


class Reports(Warnings):
    """Makes a JSON object of each event: `Event.to_dict`, `id`, `sent` in seconds since 1970, and `picture` if wanted.

    The picture is the newest that the pipeline has sent: the JPEG file in Base64, the number of its frame, and the
    width and height of a frame, which may be larger; null if there is none yet.
    """

    def __init__(self, place: str, origin: Origin) -> None:
        super().__init__(place)
        self.events = Events(origin.options)
        self._picture: dict[str, object] | None = None
        self._previews: Subscription[Preview] | None = None
        if origin.options.picture:
            self._previews = Subscription(origin.endpoint, "previews", timeout=0, keys=origin.keys)

    def update(self, tracks: Sequence[Track]) -> list[bytes]:
        with suppress(SilenceError):  # no further picture has arrived
            for each in self._previews or ():
                jpeg = b64encode(each.jpeg).decode()
                self._picture = {"frame": each.frame, "width": each.width, "height": each.height, "jpeg": jpeg}
        return [self._json(event) for event in self.events.update(tracks)]

    def close(self) -> list[bytes]:
        if self._previews is not None:
            self._previews.close()
        return [self._json(event) for event in self.events.close()]

    def _json(self, event: Event) -> bytes:
        picture = {"picture": self._picture} if self._previews is not None else {}
        return json.dumps({"id": uuid4().hex, "sent": time.time(), **event.to_dict(), **picture}).encode()


def split(place: str, form: str) -> SplitResult:
    """The parts of an address; VideoError with its `form` if it has no valid host, or characters that are not plain."""
    try:
        url = urlsplit(place)
        if url.hostname and url.hostname.encode("idna") and url.port != 0 and all("!" <= it <= "~" for it in place):
            return url
    except ValueError:
        pass
    raise VideoError(f"{redacted(place)} is not valid: expected {form}, other characters escaped as in %20")
