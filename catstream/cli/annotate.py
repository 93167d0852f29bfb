"""`catstream annotate`: tracks between boxes at keyframes of a video."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.progress import Progress

from catstream.base.files import check_distinct, locked_folder
from catstream.base.settings import Settings
from catstream.base.tables import write_table
from catstream.base.text import counted
from catstream.base.threads import cores
from catstream.cli.common import INTERRUPTS, line_of, messages, stopped
from catstream.cli.options import FOLDER, PATH, with_overrides, with_overwrite, with_reading
from catstream.cli.view import HostPort, server_of, with_listen
from catstream.errors import VideoError
from catstream.processes.job import Results
from catstream.video.images import IMAGES, natural_order, visible
from catstream.video.source import VIDEOS, open_source

if TYPE_CHECKING:
    from catstream.offline.annotation import Annotation
    from catstream.offline.session import Sessions
    from catstream.output.track_log import RunFiles


@click.command()
@click.argument("videos", nargs=-1, required=True, metavar="VIDEO...")
@click.option(
    "--box",
    "texts",
    multiple=True,
    metavar="NAME@FRAME=X,Y,W,H",
    help="A box at a keyframe, in pixels; may be repeated.",
)
@click.option("--boxes", "csv_file", type=PATH, help="CSV file of boxes: frame,object,x,y,w,h.")
@click.option(
    "--output",
    type=FOLDER,
    help="Folder for the results; by default, NAME-annotation. Of several videos, that is inside of it.",
)
@click.option("--jobs", type=click.IntRange(min=1), help="Number of processes; by default, one for each core.")
@with_listen
@with_overwrite
@with_overrides
@with_reading
def annotate(
    overrides: dict[str, object],
    videos: tuple[str, ...],
    texts: tuple[str, ...],
    csv_file: Path | None,
    output: Path | None,
    jobs: int | None,
    listen: HostPort,
    overwrite: bool,
) -> None:
    """Track objects between boxes at keyframes, and say which frames are right.

    VIDEO is a file, a folder of images, a folder of videos, or a pattern.
    Without boxes, the command serves a page on which they are drawn, for users
    with the token in its link, as catstream view does; it lists several videos,
    with a folder for the results of each. Each box is saved at once, and the
    same command continues. Ctrl-C or the button Done ends it.

    With boxes, it tracks and ends. Frames count from 0. A box is absent where
    the object is not in the frame, anna@412=absent, or hidden where too much of
    it is covered to draw one. An object without a name is @FRAME=X,Y,W,H. One
    box of each object is enough to begin with. The command prints the frame to
    look at next: add its box, and run the command again with --boxes
    OUTPUT/keyframes.csv --overwrite.

    Each stretch between two keyframes is tracked from both of its ends. A frame
    is checked if the two agree so well that its box is right with a probability
    of 97 %.

    \b
    OUTPUT
      NAME.ndjson, NAME.csv  the log of the tracks, for catstream export, with
                             checked (keyframe, hidden, checked or unchecked)
                             and probability; unchecked boxes are doubtful
      keyframes.csv          all boxes: frame,object,x,y,w,h,file; catstream
                             batch reads it as well
      next.csv               frames to look at, those with most expected errors
                             first: frame,object,errors
      passes.safetensors     finished passes, which the same command continues

    \b
    EXAMPLES
      catstream annotate walk.mp4
      catstream annotate monday/*.mp4 tuesday --output out
      catstream annotate walk.mp4 --box anna@0=120,80,64,48 --output out
      catstream annotate walk.mp4 --boxes out/keyframes.csv --box anna@412=300,90,60,50 --output out --overwrite
    """
    with INTERRUPTS.leaving():
        from catstream.offline.annotation import Annotation
        from catstream.offline.keyframes import by_object, parse_keyframe, read_keyframes

    drawn = by_object([*([] if csv_file is None else read_keyframes(csv_file)), *map(parse_keyframe, texts)])
    jobs, settings = jobs or cores(), Settings.from_values(overrides)
    if not drawn:
        _serve(_listed(videos), output, settings, jobs, listen, overwrite=overwrite)
        return
    if len(videos) > 1:
        raise click.UsageError(
            "--box and --boxes are for one video: pass one, or omit them and draw the boxes on the page"
        )
    bar = line_of(messages())
    with Annotation(
        videos[0], drawn, settings, jobs=jobs, progress=lambda *done: show_progress(bar, *done)
    ) as annotation:
        results = _ResultFiles(annotation, videos[0], output or Path(f"{annotation.frames.name}-annotation"))
        results.check(overwrite=overwrite)
        interrupted = _track(annotation, results, bar)
    _report(annotation)
    click.echo(f"results: {results.folder}")
    if interrupted:
        stopped(f"the results so far are in {results.folder}")


def _listed(words: Iterable[str]) -> list[str]:
    """The videos of paths and patterns; a folder without images is replaced by the videos and image folders in it."""

    def holds(folder: Path, kinds: set[str]) -> bool:
        return any(each.is_dir() and visible(each, kinds) for each in (folder, folder / "img"))

    videos: list[str] = []
    for word in words:
        path = Path(word)
        inside: list[Path] = []
        if path.is_dir() and not holds(path, IMAGES):
            inside = [each for each in path.iterdir() if holds(each, IMAGES | VIDEOS) or each.suffix.lower() in VIDEOS]
        elif not path.exists() and set("*?[") & set(path.name):
            inside = [each for each in path.parent.glob(path.name) if each.suffix.lower() not in IMAGES]
        inside = [each for each in inside if each.name[0] != "."]
        videos += [*map(str, sorted(inside, key=natural_order))] or [word]
    return videos


def _serve(
    videos: list[str], output: Path | None, settings: Settings, jobs: int, listen: HostPort, *, overwrite: bool
) -> None:
    """Serve the page of the videos until it is done or interrupted, and write the results."""
    from catstream.offline.annotation import Annotation
    from catstream.offline.keyframes import by_object, read_keyframes
    from catstream.offline.session import Session, Sessions

    # Step 1: select the readable videos, and name their folders.
    names: dict[str, str] = {}
    for video in videos:
        try:
            with open_source(video, settings=settings.run) as source:
                names[video] = source.name
        except VideoError as error:
            if len(videos) == 1:
                raise
            click.echo(f"skipped: {error}", err=True)
    if not names:
        raise VideoError("none of the videos can be read")
    videos, several = [*names], len(names) > 1
    labels = [
        name if [*names.values()].count(name) == 1 else f"{Path(video).absolute().parent.name}_{name}"
        for video, name in names.items()
    ]
    folders = [output] if output and not several else [(output or Path()) / f"{label}-annotation" for label in labels]
    check_distinct(zip((f"the results of {video}" for video in names), folders, strict=True), VideoError)

    # Step 2: serve the page. A video is opened when the page first shows it, with its saved boxes.
    context = click.get_current_context()

    def start(number: int) -> Session:
        annotation = Annotation(videos[number], {}, settings, jobs=jobs + 1)
        try:
            files = _ResultFiles(annotation, videos[number], folders[number])
            continues = files.keyframes.exists()
            files.check(overwrite=overwrite or continues)
            if continues:
                annotation.set_boxes(by_object(read_keyframes(files.keyframes)))
            files.begin(context)
        except BaseException:
            annotation.close()
            raise
        return Session(annotation, jobs, files.save, files.write)

    shares = [_share(folder / f"{name}.csv") for folder, name in zip(folders, names.values(), strict=True)]
    with Sessions(labels, start, shares) as sessions:
        interrupted = serve(sessions, listen)
        session = sessions.current
        if interrupted and session.decoded:
            with INTERRUPTS.deferred():
                session.write()

    # Step 3: report the results of each opened video.
    opened = sorted(sessions.opened.items())
    for number, session in opened:
        if several:
            click.echo(f"{session.annotation.frames.name}:")
        _report(session.annotation)
        if not interrupted or session.annotation.keyframes:
            click.echo(f"results: {folders[number]}")
    for _, session in opened:
        if session.problem is not None:
            raise session.problem
    if interrupted:
        drawn = any(session.annotation.keyframes for _, session in opened)
        stopped("the results so far are saved; the same command continues" if drawn else "")


def _share(log: Path) -> float:
    """The share of checked frames, from 0 to 1, in the log of an earlier command; 0 without a log."""
    text = log.read_bytes() if log.exists() else b""
    return 1 - text.count(b",unchecked,") / (text.count(b"\n") - 1) if text.count(b"\n") > 1 else 0.0


def _track(annotation: Annotation, results: _ResultFiles, bar: Progress) -> bool:
    """Track between all boxes, and write the results; return True if it was interrupted."""
    interrupted = False
    with bar:
        bar.add_task("reading", total=None)
        annotation.scan()
        results.begin(click.get_current_context())
        try:
            annotation.track()
        except KeyboardInterrupt:
            interrupted = True
        with INTERRUPTS.deferred():
            results.write()
    return interrupted


def serve(sessions: Sessions, listen: HostPort) -> bool:
    """Serve the page of sessions until it is done or interrupted; return True if it was interrupted."""
    from catstream.web.annotator import AnnotationSite

    server = server_of(AnnotationSite(sessions), listen)
    with server.in_background():
        for url in server.urls:
            click.echo(url)
        with suppress(KeyboardInterrupt):
            while not sessions.current.finished.wait(0.5):
                pass  # without a timeout, a signal just before the wait would only be handled after it
    return not sessions.current.finished.is_set()


def show_progress(bar: Progress, work: str, done: int, total: int | None) -> None:
    """Show the progress of an annotation in the only task of a display."""
    (task,) = bar.tasks
    if task.description != work:  # the remaining time counts for this part of the work
        bar.reset(task.id)
    bar.update(task.id, description=work, completed=done, total=total)


class _ResultFiles:
    """The results in a folder: the log of the tracks, the keyframes, and the frames to look at next."""

    def __init__(self, annotation: Annotation, video: str, folder: Path) -> None:
        self._annotation, self._video, self.folder = annotation, video, folder
        self.keyframes, self._next = folder / "keyframes.csv", folder / "next.csv"
        annotation.stored = folder / "passes.safetensors"

    def check(self, *, overwrite: bool) -> None:
        """Raise VideoError if a file cannot be written, or exists and may not be replaced."""
        for table in (self.keyframes, self._next):
            if table.exists() and not overwrite:
                raise VideoError(f"{table} exists already: pass --overwrite, or another --output")
        self._log().check(overwrite=overwrite, earlier=[])

    def begin(self, context: click.Context) -> None:
        """Lock the folder until the command ends, and save the keyframes; VideoError if another process locked it."""
        context.with_resource(locked_folder(self.folder, VideoError))
        self.save()

    def save(self) -> None:
        from catstream.offline.keyframes import write_keyframes

        write_keyframes(self.keyframes, self._annotation.keyframes, self._video)

    def write(self) -> None:
        """Write the log, the table of the frames to look at next, and the finished passes."""
        from catstream.output.destinations import TrackedFrame

        with self._log().opened("") as files:
            for tracks in zip(*self._annotation.tracks.values(), strict=True):
                files.write(TrackedFrame(list(tracks)))
        rows = ((frame, name, f"{errors:.1f}") for frame, name, errors in self._annotation.next_frames())
        write_table(self._next, ("frame", "object", "errors"), rows, VideoError)
        self._annotation.save_passes()

    def _log(self) -> RunFiles:
        from catstream.output.destinations import Header, Origin
        from catstream.output.track_log import RunFiles, destinations_of

        frames = self._annotation.frames
        changed = tuple(self._annotation.settings.changed())
        header = Header(source=self._video, size=frames.size, rate=frames.rate, frames=len(frames), settings=changed)
        return RunFiles(Origin(header), self.folder, destinations_of(frames.name, Results(output=self.folder)))


def _report(annotation: Annotation) -> None:
    """Print how many frames of each object are checked, and the frame to look at next."""
    from catstream.video.frames import describe_counters

    for line in describe_counters(annotation.frames.counters):
        click.echo(line)
    for name, checks in annotation.checked.items():
        count = len(checks) - checks.count("unchecked")
        boxes = counted(len(annotation.keyframes[name]), "keyframe")
        click.echo(
            f"{name and name + ': '}{count} of {len(checks)} frames checked ({count / len(checks):.0%}), {boxes}"
        )
    following = annotation.next_frame()
    if not annotation.keyframes:
        click.echo("no box was drawn")
    elif following is None:
        click.echo("all frames are checked")
    else:
        of = following.object and f" for {following.object}"
        errors = counted(max(round(following.errors), 1), "frame")
        click.echo(f"look next at frame {following.frame}{of}: about {errors} around it may be wrong")
