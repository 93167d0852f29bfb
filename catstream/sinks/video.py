"""The video with its tracks drawn in; the frames are read from the source a second time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from catstream.errors import VideoError
from catstream.messages.kinds import Track
from catstream.video.annotate import Colours, draw, drawn_size
from catstream.video.frames import RATE, Frame, without_password
from catstream.video.source import is_live, open_source
from catstream.video.writer import VideoWriter


class VideoSink:
    """An MP4 of the frames that have a track, with the tracks drawn in; it gets its name when it is closed.

    The tracks of a frame may be written one after the other.

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
                f"a video needs to read its frames again, but {without_password(source)} is live: "
                "record it, and give the file"
            )
        # The pipeline skips damaged frames and scales others, or ends at the first: in any case these are its frames.
        self._frames = open_source(source, part=part, image_rate=image_rate, skip_damaged=True, resize=True)
        self._frame: Frame | None = None  # the last one that has a track, which is not in the video yet
        self._tracks: list[Track] = []
        self._colours = Colours()
        try:
            size = drawn_size(self._frames.size)
            self._video = VideoWriter(path, self._frames.rate, size, pixel_aspect=self._frames.pixel_aspect)
        except VideoError:
            self._frames.close()
            raise

    def write(self, tracks: Sequence[Track]) -> None:
        """Draw tracks over their frame."""
        for track in tracks:
            if self._frame is None or track.frame != self._frame.number:
                self._draw()
                self._frame = self._read(track.frame)
            self._tracks.append(track)

    def publish(self) -> None:
        """Do nothing: a video gets its name when it is closed."""

    def close(self) -> None:
        """Finish the video."""
        try:
            self._draw()
        finally:
            self._frames.close()
            self._video.close()

    def _draw(self) -> None:
        """Add the last frame that has a track to the video."""
        frame, tracks = self._frame, self._tracks
        self._frame, self._tracks = None, []
        if frame is not None:
            self._colours.keep(track.object for track in tracks)
            self._video.write(draw(frame.image, tracks, self._colours), tracks[0].time)

    def _read(self, number: int) -> Frame:
        for frame in self._frames:
            if frame.number == number:
                return frame
        raise VideoError(f"the source has no frame {number}: give the one that the pipeline tracks")
