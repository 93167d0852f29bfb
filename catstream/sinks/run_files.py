"""The files of a run: its log, its video, and further destinations, from its start or from where it was interrupted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from catstream.errors import VideoError
from catstream.messages.storage import writing
from catstream.sinks.destinations import Origin, TrackedFrame, check_file, is_file, open_sink, sink_of
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

    A resumed run continues after the last frame that its log holds whole: an NDJSON file, which has all digits, or else
    a CSV file. All its logs are cut after that frame; one that is shorter or new gets the frames that it lacks from the
    first one, and a video is drawn again.

    origin  the source of the run, and the frames that are tracked
    output  folder of the results, which is made; None for none
    places  the destinations, each once
    """

    origin: Origin
    output: Path | None
    places: list[str]

    def check(self, *, overwrite: bool, earlier: list[str]) -> None:
        """Raise VideoError or MissingExtraError before the run if a destination cannot be written, or must not be.

        If `overwrite`, existing files may be replaced; those of an `earlier` part of this run are continued.
        """
        source = self.origin.source or ""
        for place in self.places:
            row = sink_of(place)
            row.load()
            if place.endswith(".mp4") and is_live(source):
                raise VideoError(
                    f"a video needs its frames once more, but {without_password(source)} is live: omit the video"
                )
            if is_file(place):
                continued = place in earlier and row.repeats and bool(self._logs())
                if place in earlier and not continued and Path(place).exists():
                    raise VideoError(f"{place} cannot be continued: to resume, give other destinations (--write DEST)")
                check_file(Path(place), may_exist=overwrite or continued, source=source, made=self.output)

    def position(self) -> int | None:
        """Return `seq` of the last frame that the log holds whole, 0 for none; None if there is to be no log."""
        if not self._logs():
            return None
        return max((frame.number + 1 for frame, _ in whole_frames(self._logs()[0])), default=0)

    def make_folder(self) -> None:
        """Make the folder of the results, in which other files of the run may be, too."""
        if self.output is not None:
            with writing(self.output, VideoError):
                self.output.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def opened(self, endpoint: str, *, resume: bool = False) -> Iterator[Callable[[TrackedFrame], None]]:
        """Yield a function that writes a frame everywhere; at the end, everything is closed.

        If `resume`, the files continue after `position`; otherwise existing ones are replaced. The function and the end
        raise VideoError if a destination cannot be written any more.
        """
        log = self._logs()[0] if resume and self._logs() else None  # before new ones exist, too
        last = max((frame.number for frame, _ in whole_frames(log)), default=-1) if log is not None else -1
        origin = replace(self.origin, endpoint=endpoint, last=last)
        with ExitStack() as stack:
            sinks = [stack.enter_context(closing(open_sink(place, origin))) for place in self.places]
            behind = [(sink, sink.last) for sink in sinks if hasattr(sink, "last") and sink.last < last]
            for frame, _ in read_frames(log) if log is not None and behind else ():
                for sink, its_last in behind:
                    if its_last < frame.number:
                        sink.write(frame)

            def write(frame: TrackedFrame) -> None:
                for sink in sinks:
                    sink.write(frame)

            yield write

    def _logs(self) -> list[Path]:
        """Return the logs, the one that is continued first."""
        logs = (Path(place) for place in self.places if is_log(Path(place)))
        return sorted(logs, key=lambda log: (not log.exists(), log.suffix == ".csv"))
