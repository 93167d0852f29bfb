"""`catstream report`: an HTML page about the tracks of a run or of a batch."""

from __future__ import annotations

from pathlib import Path

import click

from catstream.base.text import counted
from catstream.cli.common import INTERRUPTS, complain, line_of, messages
from catstream.cli.options import PATH, with_overwrite
from catstream.errors import VideoError


@click.command()
@click.argument("files", type=PATH, nargs=-1, required=True, metavar="LOG... [PAGE]")
@click.option("--skip-damaged", is_flag=True, help="Continue after a damaged line of a log.")
@click.option("--scale", default="1px", show_default=True, metavar="0.05mm", help="Size of a pixel, and its unit.")
@with_overwrite
def report(files: tuple[Path, ...], skip_damaged: bool, scale: str, overwrite: bool) -> None:
    """Write an HTML page about the tracks of a run.

    LOG is an .ndjson, .sqlite or .csv file, or a folder, for example from
    catstream batch, whose .ndjson files are reported together. Rotated files of
    a run are joined. PAGE is by default LOG with the extension .html, or
    report.html in the folder.

    The page shows a timeline of each object, distance and speed, and the frames to
    look at. PAGE-objects.csv, next to it, has the table of all objects. The video
    is read for the pictures; without it, the page has none.

    \b
    EXAMPLES
      catstream report out/walk.ndjson
      catstream report out --scale 0.05mm
      catstream report out/gate*.ndjson gate.html
    """
    with INTERRUPTS.leaving():
        from catstream.base.files import check_file
        from catstream.output.report_tracks import Scale, Section, write_report
        from catstream.output.track_log import join_rotated, logs_of

    size = Scale.parse(scale)
    page = files[-1] / "report.html" if files[-1].is_dir() else files[-1].with_suffix(".html")
    logs = join_rotated(logs_of(files[:-1] if page in files[1:] else files, skip_damaged=skip_damaged))
    table = page.with_name(f"{page.stem}-objects.csv")
    for file in (page, table):
        check_file(file, overwrite=overwrite, kind=VideoError)
    sections = []
    with line_of(messages()) as progress:
        task = progress.add_task("reading", total=len(logs))
        for log in logs:
            section = Section(log, size)
            section.add_pictures()
            sections.append(section)
            progress.advance(task)
    write_report(page, table, sections)
    for section in sections:
        if section.gap:
            complain(f"{section.name}: the log lacks {counted(section.gap, 'frame')} (the disk was full)")
        if section.problem:
            complain(f"{section.name}: no pictures ({section.problem})")
    click.echo(f"report: {page}, {table}")
