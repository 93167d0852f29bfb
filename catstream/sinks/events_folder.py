"""A folder of pictures: a JPEG file of each event, with the boxes of its frame; optionally clips, MP4 files.

    20261128T133015.250Z-entered-anna-door.jpg    time (UTC), kind, object and zone
    20261128T133015.250Z-entered-anna-door.mp4    the pictures of 5 s before and after, with their boxes

Events of one frame have one clip, which has the name of the first. If the files exceed the limit, the oldest are
removed; other files in the folder stay.
"""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from copy import deepcopy
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

from catstream.base.files import write_atomically
from catstream.errors import CatstreamError, VideoError
from catstream.jobs.job import SinkOptions
from catstream.messages.kinds import Preview, Track
from catstream.sinks.destinations import Origin, TrackedFrame
from catstream.sinks.events import Event
from catstream.sinks.remote import PicturedEvents, Warnings
from catstream.video.drawing import Colours, draw_preview, preview_image
from catstream.video.writer import ANNOTATED, VideoWriter

_OURS = re.compile(r"\d{8}T\d{6}\.\d{3}Z-.*\.(jpg|mp4)")
_UNSAFE = re.compile(r"[^\w.]+")
_TRACKS = 1024  # frames whose tracks are stored for the pictures
_CLIP_SECONDS = 5.0  # before and after an event; also without a picture, after which a clip ends
_PICTURES = 256  # capacity of the buffer for clips, which gets ten a second at most: about 15 MB
_RATE = 10.0  # average of pictures per second in a clip


class EventsFolder:
    """Writes the pictures; a folder that cannot be written to is a warning, and the run continues.

    A thread encodes the clips, one after another, from the buffered pictures. If it is late by more than 15 s, the
    first pictures of the next clip are missing.
    """

    def __init__(self, place: str, origin: Origin) -> None:
        self._folder, self._limit = _folder(place), origin.options.folder_megabytes * 1e6
        self._has_clips = origin.options.clips
        self._events, self._warnings = PicturedEvents(origin, _PICTURES if self._has_clips else 1), Warnings(place)
        self._tracks: dict[int, list[Track]] = {}  # by frame
        self._colours = Colours()
        self._clips: deque[tuple[Path, float]] = deque()  # that are due, with the times of their events
        self._encoder = ThreadPoolExecutor(1, "clips")
        self._encoded: tuple[Path, Future[None]] | None = None
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
        """Write the pictures of events that have waited, and the clips that are due."""
        self._write(self._events.update(()))

    def close(self) -> None:
        """Write what is due; clips end here."""
        self._write(self._events.close())
        while self._clips or self._encoded:
            self._encode(is_last=True)
        self._encoder.shutdown()

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
                self._failed("picture", error)
                continue
            self._add(file)
            if self._has_clips and (not self._clips or self._clips[-1][1] != event.track.time):
                self._clips.append((file.with_suffix(".mp4"), event.track.time))
        self._encode()

    def _encode(self, *, is_last: bool = False) -> None:
        """Add the clip that was encoded, and encode the next one that is due; the last ones are, and are waited for."""
        if self._encoded is not None and (is_last or self._encoded[1].done()):
            (file, done), self._encoded = self._encoded, None
            try:
                done.result()
            except (OSError, CatstreamError) as error:
                self._failed("clip", error)
            else:
                self._add(file)
        if self._clips and self._encoded is None:
            (file, middle), pictures = self._clips[0], self._events.pictures
            is_silent = time.monotonic() - self._events.last_arrival >= _CLIP_SECONDS
            if is_last or is_silent or abs(pictures[-1].time - middle) >= _CLIP_SECONDS:
                self._clips.popleft()
                near = (picture for picture in pictures if abs(picture.time - middle) <= _CLIP_SECONDS)
                pictured = [(picture, self._tracks.get(picture.frame, [])) for picture in near]
                self._encoded = file, self._encoder.submit(_write_clip, file, pictured, deepcopy(self._colours))

    def _failed(self, what: str, error: Exception) -> None:
        self._warnings.failed(f"a {what} is missing ({getattr(error, 'strerror', None) or error})")

    def _add(self, file: Path) -> None:
        """Count a new file, and remove the oldest ones above the limit."""
        self._warnings.working()
        with suppress(OSError):  # another program may have moved it
            self._files.append((file, file.stat().st_size))
        while len(self._files) > 1 and sum(size for _, size in self._files) > self._limit:
            with suppress(OSError):
                self._files.popleft()[0].unlink()


def _write_clip(file: Path, pictured: Iterable[tuple[Preview, Sequence[Track]]], colours: Colours) -> None:
    """Write pictures, each with the tracks of its frame; VideoError if there is none, or it cannot be written."""
    drawn = ((preview_image(picture, tracks, colours), picture.time) for picture, tracks in pictured)
    images = ((image, moment) for image, moment in drawn if image is not None)
    if (first := next(images, None)) is None:
        raise VideoError("no picture is so near to the event")
    height, width = first[0].shape[:2]
    with VideoWriter(file, _RATE, (width, height), comment=ANNOTATED) as video:
        for image, moment in chain([first], images):
            if image.shape == first[0].shape:  # another run may have begun at this place
                video.write(image, moment)


def _folder(place: str) -> Path:
    return Path(place.partition("://")[2])
