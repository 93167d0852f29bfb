"""Annotated videos: from the frames of a source, or from the previews of a running pipeline."""

from __future__ import annotations

from contextlib import suppress

from catstream.client.attach import subscribe
from catstream.errors import SilenceError, VideoError
from catstream.output.destinations import Header, Origin, Sink, TrackedFrame
from catstream.video.drawing import Colours, draw, drawn_size, preview_image
from catstream.video.frames import RATE
from catstream.video.source import open_source
from catstream.video.writer import VideoWriter
from catstream.wire.messages import Preview, Track

_BACKLOG = 256  # maximum number of frames whose tracks wait for a preview


def open_video(dest: str, origin: Origin) -> Sink:
    """Open an MP4 of the frames of a source if they can be read a second time, otherwise of the previews."""
    return PictureVideo(dest, origin) if origin.attached else SourceVideo(dest, origin.header)


class SourceVideo(Sink):
    """Draws tracks in the frames of the source, and writes them to an MP4."""

    def __init__(self, dest: str, header: Header) -> None:
        # With these settings, the frames are the same as the run's, which may have ended at a damaged one.
        part = slice(header.start, None, header.stride)
        self._frames = open_source(
            header.source, part=part, image_rate=header.rate or RATE, skip_damaged=True, resize=True
        )
        self._colours = Colours()
        try:
            size, aspect = drawn_size(self._frames.size), self._frames.pixel_aspect
            self._video = VideoWriter(dest, self._frames.rate, size, pixel_aspect=aspect)
        except VideoError:
            self._frames.close()
            raise

    def write(self, frame: TrackedFrame) -> None:
        image = next((source.image for source in self._frames if source.number == frame.number), None)
        if image is None:
            raise VideoError(f"the source has no frame {frame.number}: pass the source that the pipeline tracks")
        self._colours.keep(track.object for track in frame.tracks)
        self._video.write(draw(image, frame.tracks, self._colours), frame.tracks[0].time)

    def close(self) -> None:
        self._frames.close()
        self._video.close()


class PictureVideo(Sink):
    """Draws tracks in the previews of a running pipeline, and writes them to an MP4, at their true times."""

    def __init__(self, dest: str, origin: Origin) -> None:
        self._dest, self._colours = dest, Colours()
        self._previews = subscribe(origin.address, "previews", timeout=0)
        self._tracks: dict[int, list[Track]] = {}  # of the newest frames, by frame number
        self._picture: Preview | None = None  # waits for further tracks of its frame
        self._video: VideoWriter | None = None

    def write(self, frame: TrackedFrame) -> None:
        """Add tracks, and draw the next preview once all tracks of its frame have arrived."""
        self._tracks.setdefault(frame.number, []).extend(frame.tracks)
        if len(self._tracks) > _BACKLOG:
            del self._tracks[next(iter(self._tracks))]
        if self._picture is None:
            with suppress(SilenceError):
                self._picture = next(self._previews, None)
        if self._picture is None or self._picture.frame >= frame.number:
            return
        picture, self._picture = self._picture, None
        tracks = self._tracks.get(picture.frame, [])
        image = preview_image(picture, tracks, self._colours) if tracks else None
        if image is not None:
            self._colours.keep(track.object for track in tracks)
            self._video = self._video or VideoWriter(self._dest, RATE, (image.shape[1], image.shape[0]))
            self._video.write(image, tracks[0].time)

    def close(self) -> None:
        self._previews.close()
        if self._video is None:
            raise VideoError(f"{self._dest} was not written: the pipeline sent no picture of a frame that was received")
        self._video.close()
