"""The video with its tracks drawn in; the frames are read from the source a second time."""

from __future__ import annotations

from pathlib import Path

from catstream.errors import VideoError
from catstream.messages import Track
from catstream.video.annotate import AnnotatedVideo
from catstream.video.frames import RATE
from catstream.video.source import is_live, open_source

__all__ = ["VideoSink"]


class VideoSink:
    """An MP4 of the frames that have a track, with the track drawn in; it gets its name when it is closed.

    Parameters
    ----------
    source, part : those of the pipeline, so that frames have the same numbers
    image_rate : frames per second of a folder of images

    Raises
    ------
    VideoError
        From the constructor, if the source is live or cannot be read, or the file cannot be written.
    """

    def __init__(self, path: Path, source: str, part: slice, image_rate: float = RATE) -> None:
        if is_live(source):
            raise VideoError(
                f"a video needs to read its frames again, but {source} is live: record it, and give the file"
            )
        # The pipeline either skips damaged frames or ends at the first: in both cases these are its frames.
        self._frames = open_source(source, part=part, image_rate=image_rate, skip_damaged=True)
        try:
            self._video = AnnotatedVideo(path, self._frames.rate, self._frames.size, sound=self._frames.sound)
        except VideoError:
            self._frames.close()
            raise

    def write(self, track: Track) -> None:
        """Draw a track over its frame."""
        for frame in self._frames:
            if frame.number == track.frame:
                self._video.write(frame.image, track, track.time)
                return
        raise VideoError(f"the source has no frame {track.frame}: is it what the pipeline follows?")

    def close(self) -> None:
        """Finish the video."""
        self._frames.close()
        self._video.close()
