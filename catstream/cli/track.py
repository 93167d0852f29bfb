"""`catstream track`: track objects in a video."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from shlex import quote
from typing import Any

import click
from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task
from rich.table import Column
from rich.text import Text

from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.text import counted, listed
from catstream.cli.common import INTERRUPTS, line_of, messages, stopped, text
from catstream.cli.options import (
    FOLDER,
    PATH,
    with_files,
    with_object,
    with_overrides,
    with_overwrite,
    with_part,
    with_reading,
)
from catstream.cli.view import HostPort, with_token, with_view
from catstream.cli.write import with_table
from catstream.client.address import Address
from catstream.jobs.job import Results
from catstream.jobs.state import contains_run, files_of_state
from catstream.messages.kinds import Track
from catstream.pipeline import Pipeline
from catstream.sinks.destinations import SINKS, STDOUT, Origin, TrackedFrame, check_result, is_file, redacted
from catstream.sinks.track_log import RunFiles, places_of
from catstream.video.frames import describe_counters

_SAME = 0.95  # overlap of boxes that were meant to be one
_SHORTEST_SECONDS = 1.0  # a shorter run is reported without its frames per second
_REFRESH_SECONDS = 0.1  # between two updates of the progress


def _files_only(_: click.Context, __: click.Parameter, places: tuple[str, ...]) -> tuple[str, ...]:
    """Check that no destination is an address or a folder."""
    for place in places:
        if place != STDOUT and not is_file(place):
            raise click.UsageError(
                f"--write takes files, and {redacted(place)} is none: attach it to the run with catstream sink "
                f"{redacted(place)}"
            )
    return places


@click.command()
@click.argument("source", required=False)
@click.option("--output", type=PATH, help="Folder for the results.")
@click.option("--video/--no-video", default=None, help="Also write the annotated video OUTPUT/NAME.mp4.")
@click.option(
    "--write", multiple=True, metavar="FILE", callback=_files_only, help="Also write the tracks to FILE; repeatable."
)
@with_overwrite
@with_files("--save-model", "saved", "Save the model of an object to FILE at the end.")
@with_view
@with_token("view-")
@click.option("--lockstep", is_flag=True, help="Wait for each model: the run is reproducible bit for bit.")
@click.option("--paused", is_flag=True, help="Start paused, until `catstream resume`.")
@click.option("--state", type=PATH, help="Write checkpoints to this folder.")
@click.option("--resume", type=FOLDER, help="Resume the run of a --state folder.")
@click.option("--continue", "continues", is_flag=True, help="Resume the run in --state if there is one, or start it.")
@with_object
@with_part
@with_overrides
@with_reading
@with_table({suffix: row for suffix, row in SINKS.items() if is_file(suffix) or suffix == STDOUT})
def track(**options: Any) -> None:
    """Track one or several objects in a video.

    Pass the box of an object in the first frame, or a saved model; otherwise
    tracking starts after `catstream set-box`, or when a box is drawn on the web
    page. Name several objects: --box NAME=X,Y,W,H or --model NAME=FILE for each.
    `catstream set-box` and `catstream forget` add and remove objects during the
    run.

    SOURCE is a video file, a folder of images, a pattern like
    images/%05d.png, a camera (0 or /dev/video0), a stream (rtsp://... or
    http://... for MJPEG), or demo:1, a rendered live source. Live sources are
    tracked in real time: older frames are skipped and counted, and a lost source
    is reconnected.

    Ctrl-C, SIGTERM and the loss of the terminal end the run; the results so far
    are complete.

    With --state, a checkpoint is written every two seconds. After a power failure,
    a crash or Ctrl-C, --resume continues the run with the same objects, and with
    the same source, settings and results unless options change them. For a
    service, --state with --continue resumes the run in the folder if there is
    one, and starts it otherwise.

    \b
    Writes
      OUTPUT/NAME.ndjson   one JSON object for each track, with all its fields
      OUTPUT/NAME.csv      a row for each object and frame: frame, seconds, state, box,
                           score, model version, object, processing time
      OUTPUT/NAME.mp4      with --video

    NAME is the name of the source: a/walk.mp4 and b/walk.mp4 need a folder each.
    `catstream export` converts these files to the formats of annotation tools
    and benchmarks.

    --write FILE, repeatable; the suffix selects the format, and - is standard output

    {table}

    Existing files are not replaced without --overwrite. MQTT, webhooks and
    pictures of events are extra subscribers: catstream sink.

    \b
    EXAMPLES
      catstream track walk.mp4 --box 120,80,64,48 --output out --video
      catstream track walk.mp4 --box 120,80,64,48 --write - | jq .box
      catstream track walk.mp4 --box anna=120,80,64,48 --box ben=300,90,60,150 --video --output out
      catstream track walk.mp4 --box 120,80,64,48 --save-model walker.safetensors
      catstream track walk.mp4 --box 90,75,60,45 --start 500 --end 900 --stride 2
      catstream track walk.mp4 --box 120,80,64,48 --paused --set run.endpoint=run
      catstream track rtsp://10.0.0.7/stream1 --box 120,80,64,48 --output out
      catstream track 0 --model walker.safetensors
      catstream track 0 --view
      catstream track walk.mp4 --box 120,80,64,48 --output out --state checkpoints
      catstream track --resume checkpoints
      catstream track rtsp://10.0.0.7/stream1 --box 120,80,64,48 --output out --state checkpoints --continue
    """
    _Run(**options).execute()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """A run with the options of the command.

    overrides  the settings that differ from the defaults, or from those of the run that is resumed
    boxes      the objects in the first frame, by name
    models     the saved models of objects that are searched for, by name
    saved      the files for what is learned of each object, by name
    view       address of the web page; None for none
    """

    source: str | None
    boxes: dict[str, Box]
    models: dict[str, Path]
    overrides: dict[str, object]
    part: slice
    output: Path | None
    video: bool | None
    write: tuple[str, ...]
    overwrite: bool
    saved: dict[str, Path]
    view: HostPort | None
    token: str | None
    lockstep: bool
    paused: bool
    state: Path | None
    resume: Path | None
    continues: bool

    def execute(self) -> None:
        """Check everything that can be checked, then run to the end; after Ctrl-C, the exit code is 130."""
        self._check_options()
        console = messages()
        if self.continues and self.state is not None and contains_run(self.state):
            replace(self, state=None, resume=self.state, boxes={}, models={})._execute(console)
        else:
            self._execute(console)

    def _execute(self, console: Console) -> None:
        pipeline = self._pipeline()
        files = self._files(pipeline)
        for line in self._doubts(pipeline):
            console.print(line)
        if self.resume is not None:
            pipeline.first_frame = files.position(skip_damaged=pipeline.settings.run.skip_damaged)
        progress = RunProgress(pipeline)
        try:
            interrupted = self._run(pipeline, files, progress, console)
        finally:
            if progress.frames and not isinstance(sys.exception(), BrokenPipeError):
                results = [] if files.output is None else [str(files.output)]
                results += map(str, pipeline.results.write or ())
                missing = files.missing()
                console.print(progress.summary([place for place in results if Path(place).exists()]))
                if missing:
                    console.print(f"missing results, which another program removed: {', '.join(missing)}")
        if self.resume is not None and not progress.frames and not interrupted:
            console.print(
                f"no frames remained to track, the run in {self.resume} is complete: to track the source again, "
                "start a new run in another folder (--state DIR)"
            )
        saved = pipeline.saved_models
        for file in saved:
            console.print(f"saved model: {file}")
        if interrupted:
            unsaved = [str(file) for file in pipeline.results.models.values() if file not in saved]
            lost = f"; not saved: {', '.join(unsaved)}" if unsaved else ""
            folder = self.state or self.resume
            hint = ""
            if folder is not None and contains_run(folder):
                hint = f"; to continue: catstream track --resume {quote(str(folder))}"
            elif folder is not None:
                hint = f"; the state in {folder} was removed, so the run cannot be resumed"
            stopped(f"{'some results are missing' if files.missing() else 'the results so far are kept'}{lost}{hint}")

    def _check_options(self) -> None:
        """Raise UsageError if the options contradict each other."""
        if self.state and self.resume:
            raise click.UsageError("--state and --resume are mutually exclusive (new run / existing run)")
        if self.continues and not self.state:
            raise click.UsageError("missing --state DIR: --continue needs the folder of the run, which it may create")
        if not self.resume and not self.source:
            raise click.UsageError("missing SOURCE: a video, a folder of images, a camera or a stream")
        if (self.resume or self.continues) and self.overwrite:
            option = "--continue" if self.continues else "--resume"
            raise click.UsageError(
                f"{option} and --overwrite are mutually exclusive (continue / replace the existing results)"
            )
        if UNNAMED in self.saved and len(self.boxes) + len(self.models) > 1:
            raise click.UsageError("--save-model FILE is for a single object: pass NAME=FILE for each of several")

    def _pipeline(self) -> Pipeline:
        """The pipeline of the run, not started; a resumed run continues the results of its earlier part."""
        return Pipeline(
            self.source,
            self.boxes or None,
            self.overrides | ({"run.lockstep": True} if self.lockstep else {}),
            model=self.models or None,
            part=self.part,
            state=self.state,
            resume=self.resume,
            paused=self.paused,
            results=Results(  # absolute, to resume from any folder
                output=self.output and self.output.absolute(),
                video=self.video,
                write=self._destinations(),
                models={name: file.absolute() for name, file in self.saved.items()},
            ),
        )

    def _destinations(self) -> tuple[Path, ...] | None:
        """The files of `--write`, without standard output; None without the option: a resumed run keeps its files."""
        return tuple(Path(place).absolute() for place in self.write if place != STDOUT) if self.write else None

    def _files(self, pipeline: Pipeline) -> RunFiles:
        """Everything that the tracks are written to; raise an error if one of the run's files could not be written."""
        results, settings = pipeline.results, pipeline.settings.run
        if results.video and results.output is None:
            raise click.UsageError("--video requires --output, the folder for the video")
        places = [*places_of(pipeline.name, results), *([STDOUT] if STDOUT in self.write else [])]
        origin = Origin(pipeline.head, Address(keys=settings.keys))
        files = RunFiles(origin, results.output, places)
        others = {f"the saved model of {name or 'the object'}": file for name, file in results.models.items()}
        if folder := self.state or self.resume:
            others |= files_of_state(folder)
        files.check(overwrite=self.overwrite, earlier=places_of(pipeline.name, pipeline.earlier_results), others=others)
        for file in self.saved.values():
            check_result(file, overwrite=self.overwrite, source=pipeline.source, made=files.output)
        return files

    def _doubts(self, pipeline: Pipeline) -> Iterator[str]:
        """Yield descriptions of options that are valid, but hardly are what was meant."""
        objects = {*self.boxes, *self.models}
        if objects and (unknown := self.saved.keys() - objects - {UNNAMED}):  # without a name, the only one is meant
            yield f"there is no object {listed(sorted(unknown))} yet: its model is saved if one begins under this name"
        yield from _doubtful(self.boxes, *pipeline.size)

    def _run(self, pipeline: Pipeline, files: RunFiles, progress: RunProgress, console: Console) -> bool:
        """Run the pipeline, with the web page if there is one; return whether Ctrl-C or a signal ended it."""
        try:
            # The files are closed after the processes, which would track on meanwhile, for none of them; the page is
            # served until it shows the end.
            with ExitStack() as closed_last, pipeline:
                files.make_folder()
                if self.continues and self.resume is not None:
                    console.print(f"the resumed run in {self.resume} keeps its objects")
                if self.view is not None:
                    self._serve(pipeline, self.view, closed_last, console)
                with progress.line(console) as line:
                    self._write_tracks(pipeline, files, progress, line, closed_last)
        except KeyboardInterrupt:
            return True
        return False

    def _serve(self, pipeline: Pipeline, view: HostPort, stack: ExitStack, console: Console) -> None:
        """Serve the web page of the pipeline until the stack is left."""
        from catstream.web.app import Site
        from catstream.web.feed import PipelineFeed
        from catstream.web.server import Server

        feed = PipelineFeed(Address(pipeline.endpoint, keys=pipeline.settings.run.keys))
        server = Server(Site(feed), host=view.host, port=view.port, token=self.token, attempts=view.attempts)
        stack.enter_context(server.in_background())
        stack.callback(feed.wait_for_end)
        for url in server.urls:
            console.print(f"page: {url}")

    def _say_what_holds(self, pipeline: Pipeline, console: Console) -> None:
        """Say how a run goes on that is paused or has no object."""
        place = f"--endpoint {quote(pipeline.endpoint)}"
        if pipeline.holding == "waiting":
            page = "the page" if self.view is not None else f"the page of catstream view {place}"
            ways = f"draw one on {page}, or run catstream set-box [NAME=]X,Y,W,H {place}"
            console.print(f"waiting for a box: {ways}")
        elif pipeline.holding == "paused":
            console.print(f"paused: to continue, catstream resume {place}")

    def _write_tracks(
        self, pipeline: Pipeline, files: RunFiles, progress: RunProgress, line: Progress, stack: ExitStack
    ) -> None:
        """Write every track to all files, which the stack closes, and show it."""
        endpoint, has_said = pipeline.endpoint, False
        outputs, skip_damaged = None, pipeline.settings.run.skip_damaged
        if self.resume is not None:
            outputs = stack.enter_context(files.opened(endpoint, resume=True, skip_damaged=skip_damaged))
        moment = time.perf_counter()
        for tracks in pipeline.by_frame(_REFRESH_SECONDS):
            if not has_said and "detector" in pipeline.health:  # it answers commands from now on
                has_said = True
                self._say_what_holds(pipeline, line.console)
            if not tracks:
                progress.idle()
                continue
            # New files are opened with the first track: a run that cannot start does not change older results. They are
            # checked again: while this one started or waited, another run may have written them.
            outputs = outputs or stack.enter_context(self._files(pipeline).opened(endpoint))
            before, moment = moment, time.perf_counter()
            with INTERRUPTS.deferred():  # so that a frame is in all results or in none
                outputs.write(TrackedFrame([*tracks.values()], moment - before))
                progress.show(line, tracks)


def _doubtful(boxes: Mapping[str, Box], width: int, height: int) -> list[str]:
    """Descriptions of boxes that can be tracked, but are probably a mistake.

    Such a box is that of the whole frame, or one of two that are the same; or it reaches out of the frame or covers
    more than a quarter of it, and its four numbers may be two corners.

    >>> _doubtful({"anna": Box(8, 9, 40, 40), "ben": Box(8, 9, 40, 40)}, 320, 240)
    ['anna and ben have the same box: each costs time']
    >>> print(*_doubtful({"": Box(213, 121, 234, 216)}, 352, 288))
    a box of 234x216 in a frame of 352x288: if 213,121,234,216 are two corners, pass 213,121,21,95
    """
    whole = Box(0, 0, width, height)
    doubts = [
        f"the box of {listed([name])} is the whole frame: draw it around one object"
        for name, box in boxes.items()
        if box.overlap(whole) > _SAME
    ]
    doubts += [
        f"{name and name + ': '}a box of {w:g}x{h:g} in a frame of {width}x{height}: "
        f"if {x:g},{y:g},{w:g},{h:g} are two corners, pass {x:g},{y:g},{w - x:g},{h - y:g}"
        for name, (x, y, w, h) in boxes.items()
        if 0 <= x < w <= width
        and 0 <= y < h <= height
        and (x + w > width or y + h > height or 4 * w * h > width * height)
    ]
    return doubts + [
        f"{one} and {other} have the same box: each costs time"
        for (one, box), (other, twin) in combinations(boxes.items(), 2)
        if box.overlap(twin) > _SAME
    ]


@dataclass(slots=True)
class _ObjectCounts:
    """The counters of an object: frames in which it was tracked, and present; the newest version of its model."""

    frames: int = 0
    present: int = 0
    version: int = 0


class _State(ProgressColumn):
    """The state of the objects; while there are no tracks, why: the source is lost, or the run is paused or waits."""

    def __init__(self, pipeline: Pipeline) -> None:
        super().__init__(Column(no_wrap=True))
        self._pipeline = pipeline

    def render(self, task: Task) -> Text:
        lost = self._pipeline.lost_seconds
        return Text(f"{f'lost {lost:.0f} s' if lost else self._pipeline.holding or task.description:13}")


class RunProgress:
    """Counts the tracks of a run, and shows them during the run and at its end."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._held, self._looked = 0.0, time.perf_counter()  # seconds while the run was held, and until when
        self._started = self._now()
        self._first = self._refreshed = 0.0
        self.frames = 0
        self._objects: dict[str, _ObjectCounts] = {}

    def line(self, console: Console) -> Progress:
        """The line that `show` updates."""
        total = "" if self._pipeline.live else f"/{self._pipeline.frames or '?'}"
        count = text("{task.completed:.0f}" + total)
        line = line_of(console, _State(self._pipeline), count, text("{task.fields[figures]}", last=True))
        self._task = line.add_task("starting", total=self._pipeline.frames, figures="")
        return line

    def _now(self) -> float:
        """A clock, in seconds, which stands still while the run is paused, waits for a box, or has lost its source."""
        return self._looked - self._held

    def idle(self) -> None:
        """Note a moment without a frame."""
        before, self._looked = self._looked, time.perf_counter()
        if self._pipeline.holding:
            self._held += self._looked - before

    def show(self, line: Progress, tracks: Mapping[str, Track]) -> None:
        """Count and show the tracks of a frame."""
        self._looked = time.perf_counter()
        now = self._now()
        self._first = self._first or now - self._started
        self.frames += 1
        for name, track in tracks.items():
            counts = self._objects.setdefault(name, _ObjectCounts())
            counts.frames += 1
            counts.present += track.box is not None
            counts.version = track.model_version
        if not line.disable and now - self._refreshed >= _REFRESH_SECONDS:
            self._refreshed = now
            present = sum(track.box is not None for track in tracks.values())
            states = [track.state for track in tracks.values()]
            state = states[0] if len(states) == 1 else f"{present}/{len(states)} present"
            line.update(self._task, completed=self.frames, description=state, figures=self._figures(tracks))

    def _figures(self, tracks: Mapping[str, Track]) -> str:
        figures = [f"{self._rate():.0f} frames/s"]
        if self._pipeline.live:
            figures.append(f"{self._counters.get('skipped', 0):.0f} skipped")
        if len(tracks) == 1:
            (track,) = tracks.values()
            figures += [f"score {track.score:+.2f}", f"model {track.model_version}"]
        else:
            figures += [f"{name or '(no name)'} {track.score:+.2f}" for name, track in tracks.items()]
        return "  ".join([*figures, f"{self._pipeline.health.get('compressor', {}).get('leaves', 0):.0f} leaves"])

    def summary(self, results: Sequence[str]) -> str:
        """The closing lines of the run."""
        self.idle()
        rate = f"first track after {self._first:.2f} s"
        if self._seconds() >= _SHORTEST_SECONDS:
            rate = f"{self._rate():.0f} frames/s, {rate}"
        frames = counted(self.frames, "frame")
        if self._objects.keys() == {UNNAMED}:
            alone = self._objects[UNNAMED]
            lines = [f"{frames}, present in {alone.present}, {rate}, model version {alone.version}"]
        else:
            lines = [f"{frames}, {rate}"]
            for name, counts in self._objects.items():
                present = f"present in {counts.present} of {counts.frames} frames"
                lines.append(f"  {name or '(no name)'}: {present}, model version {counts.version}")
        if self._pipeline.live:
            skipped = counted(self._counters.get("skipped", 0), "frame")
            reconnects = counted(self._counters.get("reconnects", 0), "reconnect")
            lines.append(f"live: {skipped} skipped, {reconnects}")
        lines += describe_counters(self._counters)
        if totals := self._pipeline.totals:
            sent = counted(totals["sent"], "message")
            lines.append(f"features: {sent} sent, {totals['stored']} stored in the coreset trees")
        if self._pipeline.restarts:
            lines.append(f"processes restarted: {self._pipeline.restarts}")
        if results:
            here = f"{Path.cwd()}/"
            lines.append(f"results: {', '.join(place.removeprefix(here) for place in results)}")
        return "\n".join(lines)

    @property
    def _counters(self) -> dict[str, float]:
        """The counters of the detector: those of its last health report, and after the end of the run the totals."""
        return self._pipeline.health.get("detector", {}) | self._pipeline.totals

    def _rate(self) -> float:
        return (self.frames - 1) / max(self._seconds(), 1e-9)

    def _seconds(self) -> float:
        """Seconds since the first track."""
        return self._now() - self._started - self._first
