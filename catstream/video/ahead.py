"""Reading ahead: the next frame of a recording is decoded while one is followed."""

from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor

from catstream.video.frames import Frame, Source

__all__ = ["read_ahead"]


def read_ahead(source: Source) -> Generator[Frame]:
    """The frames of a source, one of them read before it is asked for: FFmpeg decodes without Python's lock.

    Not for a live source, whose newest frame it would hold back. Raises what the source raises, in its turn. Close it
    before the source.
    """
    with ThreadPoolExecutor(1, "reader") as reader:
        coming = reader.submit(next, source, None)
        while (frame := coming.result()) is not None:
            coming = reader.submit(next, source, None)
            yield frame
