"""A folder of pictures: a JPEG file of each event, with the boxes of its frame.

    20261128T133015.250Z-entered-anna-door.jpg    time (UTC), kind, object and zone

If the files exceed the limit, the oldest are removed; other files in the folder stay.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from catstream.base.files import write_atomically
from catstream.errors import CatstreamError, VideoError
from catstream.jobs.job import SinkOptions
from catstream.messages.kinds import Preview, Track
from catstream.sinks.destinations import Origin, TrackedFrame
from catstream.sinks.events import Event
from catstream.sinks.remote import PicturedEvents, Warnings
from catstream.video.drawing import Colours, draw_preview

_OURS = re.compile(r"\d{8}T\d{6}\.\d{3}Z-.*\.jpg")
_UNSAFE = re.compile(r"[^\w.]+")
_TRACKS = 1024  # frames whose tracks are stored for the pictures


class EventsFolder:
    """Writes the pictures; a folder that cannot be written to is a warning, and the run continues."""

    def __init__(self, place: str, origin: Origin) -> None:
        self._folder, self._limit = _folder(place), origin.options.folder_megabytes * 1e6
        self._events, self._warnings = PicturedEvents(origin), Warnings(place)
        self._tracks: dict[int, list[Track]] = {}  # by frame
        self._colours = Colours()
        self._folder.mkdir(parents=True, exist_ok=True)
        ours = sorted(file for file in self._folder.iterdir() if _OURS.fullmatch(file.name))
        self._files = deque((file, file.stat().st_size) for file in ours)

    @staticmethod
    def check(place: str, _: SinkOptions) -> None:
        """Raise VideoError if the folder cannot be made."""
        try:
            _folder(place).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise VideoError(f"cannot make the folder {_folder(place)}: {error.strerror}") from None

    def write(self, frame: TrackedFrame) -> None:
        self._tracks.setdefault(frame.number, []).extend(frame.tracks)
        if len(self._tracks) > _TRACKS:
            del self._tracks[next(iter(self._tracks))]
        self._write(self._events.update(frame.tracks))

    def idle(self) -> None:
        """Write the pictures of events that have waited."""
        self._write(self._events.update(()))

    def close(self) -> None:
        """Write the pictures of the last events."""
        self._write(self._events.close())

    def _write(self, events: Iterable[tuple[Event, Preview | None]]) -> None:
        for event, picture in events:
            if picture is None:
                continue
            tracks = self._tracks.get(picture.frame, [])
            self._colours.keep(track.object for track in tracks)
            words = (f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}"[:-3] + "Z", event.kind, event.track.object, event.zone)
            file = self._folder / ("-".join(_UNSAFE.sub("_", word) for word in words if word) + ".jpg")
            try:
                write_atomically(file, draw_preview(picture, tracks, self._colours))
            except (OSError, CatstreamError) as error:
                self._warnings.failed(f"a picture is missing ({getattr(error, 'strerror', None) or error})")
                continue
            self._add(file)

    def _add(self, file: Path) -> None:
        """Count a new file, and remove the oldest ones above the limit."""
        self._warnings.working()
        with suppress(OSError):  # another program may have moved it
            self._files.append((file, file.stat().st_size))
        while len(self._files) > 1 and sum(size for _, size in self._files) > self._limit:
            with suppress(OSError):
                self._files.popleft()[0].unlink()


def _folder(place: str) -> Path:
    return Path(place.partition("://")[2])
