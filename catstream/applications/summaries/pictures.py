"""Small pictures of the frames of a run, read from its source."""

from __future__ import annotations

import numpy as np

from catstream.applications.summaries.taught import TaughtFrame
from catstream.errors import VideoError
from catstream.messages.kinds import Health
from catstream.sinks.recording.file import Recording
from catstream.video.annotate import thumbnail
from catstream.video.source import is_live, open_source

__all__ = ["WIDTH", "pictures_of", "source_of"]

#: Width of a picture in pixels.
WIDTH = 420

_TOLERANCE_SECONDS = 1e-3
_NO_BOX = np.full(4, np.nan)


def source_of(recording: Recording) -> str:
    """Return the source that the detector reported; empty if the recording does not name it."""
    reports = (message for _, message in recording.messages() if isinstance(message, Health))
    return next((report.source for report in reports if report.source), "")


def pictures_of(frames: list[TaughtFrame], source: str, image_rate: float) -> dict[int, bytes]:
    """Read frames of a source, with the object's box drawn in.

    The frames are found by their time, because the frames of a run are numbered from its first one.

    Returns
    -------
    JPEG files by the number of the frame

    Raises
    ------
    VideoError
        If the source is live, cannot be read, or has no frame at one of these times.
    """
    if is_live(source):
        raise VideoError(f"{source!r} is a live source, and its frames were not kept")
    found: dict[int, bytes] = {}
    waiting = sorted(frames, key=lambda frame: -frame.time)
    with open_source(source, image_rate=image_rate, skip_damaged=True, resize=True) as images:
        for image in images:
            while waiting and waiting[-1].time < image.time - _TOLERANCE_SECONDS:
                waiting.pop()
            if waiting and abs(waiting[-1].time - image.time) <= _TOLERANCE_SECONDS:
                frame = waiting.pop()
                box = _NO_BOX if frame.box is None else np.array(frame.box, np.float64)
                found[frame.frame] = thumbnail(image.image, _NO_BOX, box, WIDTH)
            if not waiting:
                break
    if missing := len(frames) - len(found):
        raise VideoError(f"{missing} of {len(frames)} frames are not in {source!r}: it is not the video of this run")
    return found
