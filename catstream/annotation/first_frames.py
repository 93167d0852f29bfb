"""Boxes in the first frames of several videos: an annotation with one frame for each video, which tracks nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from catstream.annotation.annotation import Annotation, Progress, Task
from catstream.annotation.keyframes import Keyframe, by_object
from catstream.base.arrays import UInt8
from catstream.base.settings import RunSettings, Settings
from catstream.errors import VideoError
from catstream.video.video_frames import VideoFrames


class _Frames(VideoFrames):
    """The first frame of each of some videos, which are opened again for each picture."""

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.name, self.rate, self.size, self.times = "", 0.0, (0, 0), np.zeros(0)
        self.counters, self.is_exact = {}, True
        self._folder, self.settings = folder, settings
        self._videos: list[tuple[str, tuple[int, int]]] = []

    def append(self, file: str) -> None:
        """Add a video; VideoError if it cannot be read."""
        self._videos.append((file, self._opened(file).size))
        self.times = np.zeros(len(self._videos))

    def __getitem__(self, number: int) -> UInt8:
        return self._opened(self._videos[number][0])[0]

    def size_of(self, number: int) -> tuple[int, int]:
        return self._videos[number][1]

    def scan(self, *_: object, **__: object) -> None:
        pass

    def close(self) -> None:
        pass

    def _opened(self, file: str) -> VideoFrames:
        return VideoFrames(self._folder / file, slice(0, 1), self.settings)


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

    def _open(self, video: str, _: slice) -> VideoFrames:
        frames = _Frames(Path(video), self.settings.run)
        for number, file in enumerate(self._files):
            try:
                frames.append(file)
            except VideoError as error:
                self.errors.append(error)
            else:
                self.videos.append(file)
            self.progress("opening", number + 1, len(self._files))
        return frames
