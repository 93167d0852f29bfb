"""Reading ahead: the next frame of a file is decoded while the current frame is tracked."""

from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor

from catstream.video.frames import Frame, Source


def read_ahead(source: Source) -> Generator[Frame]:
    """Yield the frames of a source, and read the next one in a thread meanwhile: FFmpeg decodes without the GIL.

    It is not for live sources, because the frame that was read ahead would be out of date. Errors of the source are
    raised in order, after the frames before them. Close the generator before the source.
    """
    with ThreadPoolExecutor(1, "reader") as reader:
        coming = reader.submit(next, source, None)
        while (frame := coming.result()) is not None:
            coming = reader.submit(next, source, None)
            yield frame
