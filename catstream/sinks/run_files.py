"""The files of a run: its log, its video, and further destinations, from its start or from where it was interrupted."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from catstream.box import Box
from catstream.errors import VideoError
from catstream.messages.kinds import ObjectPosition, Position
from catstream.messages.storage import writing
from catstream.sinks.destinations import Origin, Sink, TrackedFrame, check_file, is_file, open_sink, sink_of
from catstream.sinks.track_log import is_log, read_frames, whole_frames
from catstream.video.frames import without_password
from catstream.video.source import is_live


def places_of(name: str, output: Path | None, video: bool) -> list[str]:
    """Return the files of a run of this name in a folder of results: the log in both forms, and the video."""
    kinds = ("ndjson", "csv", *(["mp4"] if video else []))
    return [] if output is None else [str(output / f"{name}.{kind}") for kind in kinds]


@dataclass(frozen=True, slots=True)
class RunFiles:
    """All destinations of a run.

    A resumed run continues after the last frame that one of its logs, NDJSON or CSV, holds whole. Each log is cut after
    its own last whole frame, and gets the frames that it lacks from that one; a video is drawn again.

    origin  the source of the run, and the frames that are tracked
    output  folder of the results, which is made; None for none
    places  the destinations, each once
    """

    origin: Origin
    output: Path | None
    places: list[str]

    def check(self, *, overwrite: bool, earlier: list[str]) -> None:
        """Raise an error before the run if a destination cannot be written, or must not be.

        Parameters
        ----------
        overwrite : whether existing files may be replaced
        earlier : the destinations of an earlier part of this run, which are continued
        """
        source = self.origin.source or ""
        for place in self.places:
            row = sink_of(place)
            row.load()
            if row.name == "video" and is_live(source):
                raise VideoError(
                    f"a video needs its frames once more, but {without_password(source)} is live: omit the video"
                )
            if is_file(place):
                continued = place in earlier and row.repeats and bool(self._logs())
                if place in earlier and not continued and Path(place).exists():
                    raise VideoError(f"{place} cannot be continued: to resume, give other destinations (--write DEST)")
                check_file(Path(place), may_exist=overwrite or continued, source=source, made=self.output)

    def position(self) -> Position | None:
        """Return the position of the last frame that a log holds whole; None if there is no log."""
        if not self._logs():
            return None
        lasts = {log: max((frame.number for frame, _ in whole_frames(log)), default=-1) for log in self._logs()}
        frames = 0
        boxes: dict[str, Box | None] = {}
        objects: list[str] = []
        for frame, _ in whole_frames(max(lasts, key=lambda log: lasts[log])):
            frames, objects = frame.number + 1, [track.object for track in frame.tracks]
            boxes |= {track.object: track.box for track in frame.tracks if track.box is not None}
        return Position(frames, max(frames - 1, 0), {name: ObjectPosition(boxes.get(name)) for name in objects})

    def make_folder(self) -> None:
        """Make the folder of the results, in which other files of the run may be, too."""
        if self.output is not None:
            with writing(self.output, VideoError):
                self.output.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def opened(self, endpoint: str, *, resume: bool = False) -> Iterator[Callable[[TrackedFrame], None]]:
        """Yield a function that writes a frame everywhere; at the end, everything is closed.

        Parameters
        ----------
        endpoint : of the run
        resume : whether to continue after `position`; otherwise existing files are replaced

        Raises
        ------
        VideoError
            If a destination cannot be written; also later, from the function and at the end.
        """
        origin = replace(self.origin, endpoint=endpoint, resume=resume)
        with ExitStack() as stack:
            sinks = {place: stack.enter_context(closing(open_sink(place, origin))) for place in self.places}
            if resume:
                self._complete(sinks)

            def write(frame: TrackedFrame) -> None:
                for sink in sinks.values():
                    sink.write(frame)

            yield write

    def _complete(self, sinks: dict[str, Sink]) -> None:
        """Write to each sink the frames that it lacks, from the longest log: that was cut, so its frames are whole."""
        lasts = {place: getattr(sink, "last", sys.maxsize) for place, sink in sinks.items()}
        longest = max(self._logs(), key=lambda log: lasts[str(log)], default=None)
        if longest is not None and min(lasts.values()) < lasts[str(longest)]:
            for frame, _ in read_frames(longest):
                for place, sink in sinks.items():
                    if lasts[place] < frame.number:
                        sink.write(frame)

    def _logs(self) -> list[Path]:
        """Return the logs, NDJSON first: it has all fields."""
        return sorted(
            (Path(place) for place in self.places if is_log(Path(place))), key=lambda log: log.suffix == ".csv"
        )
