"""Reads the properties of a source before the processes of a run start."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from catstream.base.addresses import is_live
from catstream.base.names import check_boxes
from catstream.client.saved_model import check_files
from catstream.errors import SettingsError
from catstream.processes.job import Job
from catstream.video.source import open_source


class SourceInfo(NamedTuple):
    """The properties of a source.

    name    name for results: the stem of a file, or the name of a folder
    frames  number of frames, None if unknown
    rate    frames per second
    size    width and height of a frame
    live    whether it is a camera or a stream
    """

    name: str
    frames: int | None
    rate: float
    size: tuple[int, int]
    live: bool


def probe(job: Job) -> tuple[Job, SourceInfo]:
    """Complete a job with the properties of its source, and make paths absolute.

    The source is opened and closed again, because only one program at a time can open a camera.
    SettingsError if the settings do not suit the source, VideoError if it cannot be read; BoxError if a box is outside
    the frame; ServiceError or ProtocolError if a saved model cannot be used.
    """
    if job.settings.run.lockstep and is_live(job.source):
        raise SettingsError("lockstep needs a file: a live source does not wait, so its runs are not reproducible")
    with open_source(job.source, part=job.part, settings=job.settings.run) as source:
        info = SourceInfo(source.name, source.frames, source.rate, source.size, source.live)
    check_boxes(job.boxes, *info.size)
    settings = job.settings.for_length(info.frames)
    check_files(job.models, settings)
    path = job.source if info.live else str(Path(job.source).absolute())
    return replace(job, source=path, size=info.size, rate=info.rate, settings=settings), info
