"""Boxes in the first frames of several videos: an annotation with one frame for each video, which tracks nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from catstream.annotation.annotation import Annotation, Progress, Task
from catstream.annotation.decoded import DecodedFrames, decode
from catstream.annotation.keyframes import Keyframe, by_object
from catstream.base.arrays import UInt8
from catstream.base.settings import Settings
from catstream.errors import VideoError
from catstream.video.source import open_source


@dataclass(frozen=True, slots=True)
class _Frames(DecodedFrames):
    """The first frame of each of `videos`."""

    videos: list[DecodedFrames] = field(default_factory=list)

    def __getitem__(self, number: int) -> UInt8:
        return self.videos[number][0]

    def size_of(self, number: int) -> tuple[int, int]:
        return self.videos[number].size


class FirstFrames(Annotation):
    """An annotation whose frame N is the first frame of video N.

    Parameters
    ----------
    folder : folder to which the paths of videos are relative
    boxes : mapping of the path of each video to its boxes; those in frame 0 can be edited
    settings : for the readers of the videos
    progress : function that is called after each video

    Attributes
    ----------
    videos : paths of the videos that can be read
    errors : reasons why the other videos cannot be read
    """

    def __init__(
        self, folder: Path, boxes: Mapping[str, Sequence[Keyframe]], settings: Settings, progress: Progress
    ) -> None:
        self.videos: list[str] = []
        self.errors: list[VideoError] = []
        self._files = list(boxes)
        super().__init__(folder, {}, settings, jobs=1, progress=progress)
        self._others: dict[str, list[Keyframe]] = {file: [] for file in boxes}  # boxes that cannot be edited
        editable: list[Keyframe] = []
        for file, keyframes in boxes.items():
            for name, frame, box in keyframes:
                if file in self.videos and frame == 0 and box is not None:
                    editable.append((name, self.videos.index(file), box))
                else:
                    self._others[file].append((name, frame, box))
        self.set_boxes(by_object(editable))

    @property
    def boxes(self) -> dict[str, list[Keyframe]]:
        """The boxes of each video by its path, also those in other frames, and of videos that cannot be read."""
        boxes = {file: [*others] for file, others in self._others.items()}
        for name, drawn in self.keyframes.items():
            for number, box in drawn.items():
                boxes[self.videos[number]].append((name, 0, box))
        return boxes

    def missing(self) -> list[Task]:
        return []

    def _open(self, video: str, _: slice) -> tuple[None, DecodedFrames]:
        frames = _Frames(Path(self._folder.name), (0, 0), [], 0.0, "")
        for number, file in enumerate(self._files):
            try:
                source = open_source(Path(video) / file, part=slice(0, 1), settings=self.settings.run)
                first = DecodedFrames(frames.path / str(number), source.size, [], source.rate, file)
                decode(source, first, lambda *_: None)
            except VideoError as error:
                self.errors.append(error)
            else:
                self.videos.append(file)
                frames.videos.append(first)
                frames.times.extend(first.times)
            self.progress("opening", number + 1, len(self._files))
        return None, frames
