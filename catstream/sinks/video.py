"""The video with its tracks drawn in, from its frames read once more."""

from __future__ import annotations

from pathlib import Path

from catstream.errors import VideoError
from catstream.messages import Track
from catstream.video.annotate import AnnotatedVideo
from catstream.video.frames import RATE
from catstream.video.source import is_live, open_source

__all__ = ["VideoSink"]


class VideoSink:
    """Frames with their tracks as MP4, which gets its name when it is closed; those without a track are left out.

    Parameters
    ----------
    source, part : as the pipeline has them, so that frames have the same numbers
    image_rate : frames per second of a folder of images

    Raises
    ------
    VideoError
        From the constructor, where the source is live or cannot be read, or the file cannot be written.
    """

    def __init__(self, path: Path, source: str, part: slice, image_rate: float = RATE) -> None:
        if is_live(source):
            raise VideoError(f"a video of {source} needs its frames once more, and those of a live source are gone")
        # The pipeline ends at a damaged place unless it skips those: either way these are its frames.
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
