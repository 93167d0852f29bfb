"""A folder of events: a line of JSON for each in `events.ndjson`, and a JPEG file of the frame with its boxes.

    20261128T133015.250Z-entered-anna-door.jpg    time (UTC), kind, object and zone

If the pictures exceed the limit, the oldest are removed; `events.ndjson` is renamed to `events.1.ndjson` at 10 MB.
Other files in the folder are not changed.
"""

from __future__ import annotations

import json
import re
import time
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from catstream.base.files import write_atomically
from catstream.errors import CatstreamError, VideoError
from catstream.output.destinations import Origin, Sink, SinkOptions, TrackedFrame
from catstream.output.events import Event
from catstream.output.remote import EventStream, Warnings
from catstream.video.drawing import Colours, draw_preview
from catstream.wire.messages import Preview, Track

_PICTURE = re.compile(r"\d{8}T\d{6}\.\d{3}Z-.*\.jpg")
_UNSAFE = re.compile(r"[^\w.]+")
_TRACKS = 1024  # frames whose tracks are stored for the pictures
_LOG_BYTES = 10_000_000


class EventsFolder(Sink):
    """Writes the files; if the folder is not writable, a warning is logged, and the run continues."""

    def __init__(self, dest: str, origin: Origin) -> None:
        self.check(dest, origin.options)
        self._folder, self._limit = Path(dest), origin.options.megabytes * 1e6
        self._events, self._warnings = EventStream(origin, has_pictures=True), Warnings(dest)
        self._tracks: dict[int, list[Track]] = {}  # by frame
        self._colours = Colours()
        pictures = sorted(file for file in self._folder.iterdir() if _PICTURE.fullmatch(file.name))
        self._files = deque((file, file.stat().st_size) for file in pictures)

    @staticmethod
    def check(dest: str, _: SinkOptions) -> None:
        """Create the folder; raise VideoError if this fails."""
        try:
            Path(dest).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise VideoError(f"cannot create the folder {dest}: {error.strerror}") from None

    def write(self, frame: TrackedFrame) -> None:
        self._tracks.setdefault(frame.number, []).extend(frame.tracks)
        if len(self._tracks) > _TRACKS:
            del self._tracks[next(iter(self._tracks))]
        self._write(self._events.update(frame.tracks))

    def idle(self) -> None:
        """Write the events that no longer wait for a picture."""
        self._write(self._events.update())

    def close(self) -> None:
        """Write the last events."""
        self._write(self._events.close())

    end = close

    def _write(self, events: Iterable[tuple[Event, Preview | None]]) -> None:
        for event, picture in events:
            try:
                name = None if picture is None else self._write_picture(event, picture)
                self._log({"sent": time.time(), **event.to_dict(), "picture": name})
            except (OSError, CatstreamError) as error:
                self._warnings.failed(f"an event is missing ({getattr(error, 'strerror', None) or error})")
            else:
                self._warnings.working()

    def _write_picture(self, event: Event, picture: Preview) -> str:
        """Write the picture of an event, remove the oldest pictures above the limit, and return the file name."""
        tracks = self._tracks.get(picture.frame, [])
        self._colours.keep(track.object for track in tracks)
        name = "" if event.track is None else event.track.object
        words = (f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}"[:-3] + "Z", event.kind, name, event.zone)
        file = self._folder / ("-".join(_UNSAFE.sub("_", word) for word in words if word) + ".jpg")
        data = draw_preview(picture, tracks, self._colours)
        write_atomically(file, data)
        self._files.append((file, len(data)))
        while len(self._files) > 1 and sum(size for _, size in self._files) > self._limit:
            with suppress(OSError):  # another program may have removed it
                self._files.popleft()[0].unlink()
        return file.name

    def _log(self, fields: dict[str, object]) -> None:
        log = self._folder / "events.ndjson"
        with log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(fields) + "\n")
            size = file.tell()
        if size > _LOG_BYTES:
            log.replace(self._folder / "events.1.ndjson")
