"""A pass: tracks an object from a keyframe in one direction, to the next keyframe or to the end of the video.

A pass is built from the stages of `catstream.MultiTracker`. Its tracker starts at the box of the keyframe, with or
without a memory: the merged coreset trees of all other boxes of the object.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catstream.base.arrays import Float64
from catstream.base.box import Box
from catstream.base.names import UNNAMED
from catstream.base.settings import Settings
from catstream.base.system import release_memory
from catstream.base.threads import one_thread
from catstream.client.saved_model import SavedModel, merge
from catstream.coreset.forest import Forest
from catstream.detection.objects import Detectors
from catstream.errors import BoxError
from catstream.features.pyramid import Pyramid
from catstream.multi import MultiTracker
from catstream.training.trainer import Trainer
from catstream.video.video_frames import VideoFrames
from catstream.wire.messages import Track

#: The boxes of an object at its keyframes, by frame number; None where it is absent.
Keyframes = Mapping[int, Box | None]

#: Name of a file in the folder of the models, see `run_pass`.
PAUSED = "paused"
_PAUSE_SECONDS = 0.01  #: polling interval for this file

_TRIMMED = 32  #: interval in frames at which freed memory is returned to the system

_NEAR = 0.4  #: IoU with the box of a keyframe above which a pass has not lost the object


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """The boxes of a pass, or of a part of it.

    start        first frame, a keyframe
    stop         last frame: the next keyframe, or the end of the video; less than `start` if it runs backwards
    boxes        float64 (frames, 4), pixels, from the frame after `start` to `stop`; NaN where the object is absent
    scores       float64 (frames,), scores of the tracker
    with_memory  whether it began with the model of the other boxes of the object
    """

    start: int
    stop: int
    boxes: Float64
    scores: Float64
    with_memory: bool = False

    @property
    def is_forward(self) -> bool:
        return self.stop > self.start

    def covers(self, start: int, stop: int) -> bool:
        """Return True if it contains the frames from `start` to `stop`, in this direction."""
        sign = 1 if self.is_forward else -1
        return sign * self.start <= sign * start < sign * stop <= sign * self.stop

    def is_near(self, frame: int, box: Box | None) -> bool:
        """Return True if its box in a frame after the start is near a box; None means absence."""
        return bool(iou(self.boxes[abs(frame - self.start) - 1], row_of(box)) > _NEAR)

    def part(self, start: int, stop: int, keyframes: Keyframes) -> Pass | None:
        """The part from a keyframe `start` to `stop`; None if it is not covered, or if the object was lost before."""
        if not self.covers(start, stop):
            return None
        passed = range(start, self.start, -1 if self.is_forward else 1)
        if not all(self.is_near(frame, keyframes[frame]) for frame in passed if frame in keyframes):
            return None
        part = slice(abs(start - self.start), abs(stop - self.start))
        return Pass(start, stop, self.boxes[part], self.scores[part], self.with_memory)


def row_of(box: Box | None) -> Float64:
    """A box as float64 (4,); NaN for None."""
    return np.array([np.nan] * 4 if box is None else box, np.float64)


def box_of(row: Float64) -> Box | None:
    """The box of a row; None for NaN."""
    return None if np.isnan(row[0]) else Box(*row.tolist())


def iou(one: Float64, other: Float64) -> Float64:
    """Intersection over union of boxes (..., 4); 1 if both are NaN, 0 if only one is."""
    low = np.maximum(one[..., :2], other[..., :2])
    high = np.minimum(one[..., :2] + one[..., 2:], other[..., :2] + other[..., 2:])
    shared = np.prod(np.maximum(high - low, 0), axis=-1)
    union = np.prod(one[..., 2:], axis=-1) + np.prod(other[..., 2:], axis=-1) - shared
    both_absent = np.isnan(one[..., 0]) & np.isnan(other[..., 0])
    ratios: Float64 = np.where(both_absent, 1.0, np.nan_to_num(shared / union))
    return ratios


@one_thread(opencv=True)
def run_pass(
    frames: VideoFrames,
    start: int,
    stop: int,
    keyframes: Keyframes,
    settings: Settings,
    models: Path,
    *,
    use_memory: bool,
    count: Path | None = None,
) -> Pass | None:
    """Track the object of keyframes from the keyframe `start` to the frame `stop`.

    Without the memory, only the box at `start` is used. With it, an object that is absent at `start` is searched for in
    the following frames. Returns None if tracking cannot start: without a box, or if the box looks like its
    surroundings.

    models : folder for the models of the boxes; while it contains a file PAUSED, the pass waits
    count : file whose size is set to the number of frames so far; if it is deleted, the pass ends with an OSError
    """
    box, others = keyframes[start], {number: box for number, box in keyframes.items() if number != start}
    memory = _memory(frames, others, settings, models) if use_memory else None
    if box is None and memory is None:
        return None
    step = 1 if stop > start else -1
    numbers = range(start, stop + step, step)
    try:
        tracks = [*_tracks(_images(frames, numbers, models, count), box, memory, settings)][1:]
    except BoxError:
        return None
    boxes = np.stack([row_of(track.box) for track in tracks])
    return Pass(start, stop, boxes, np.array([track.score for track in tracks], np.float64), use_memory)


def _images(frames: VideoFrames, numbers: Iterable[int], models: Path, count: Path | None) -> Iterator[np.ndarray]:
    for done, number in enumerate(numbers, 1):
        while (models / PAUSED).exists():
            time.sleep(_PAUSE_SECONDS)
        if count is not None:
            os.truncate(count, done)
        if number % _TRIMMED == 0:
            release_memory()
        yield frames[number]


def _tracks(
    images: Iterable[np.ndarray], box: Box | None, memory: SavedModel | None, settings: Settings
) -> Iterator[Track]:
    """Track from a box in the first image or, without a box, search for the object of a saved model."""
    detectors, forest, trainer = Detectors(settings), Forest(settings), Trainer(settings)
    for number, image in enumerate(images):
        pyramid, results, continued = Pyramid(image), {}, {}
        if number == 0:
            if memory is not None:
                continued = {UNNAMED: memory.compressor(settings)}
            if box is not None:
                results = detectors.begin_all({UNNAMED: box}, pyramid)
            elif memory is not None:
                detectors.seek(UNNAMED, memory.model, memory.box, memory.similarity())
        tracks, features = detectors.step(pyramid, 0.0, results)
        for sample in forest.take(features, continued):
            detectors.adopt(trainer.train(sample))
        yield tracks.tracks[UNNAMED]


def _memory(frames: VideoFrames, keyframes: Keyframes, settings: Settings, models: Path) -> SavedModel | None:
    """The merged model of the boxes of an object. The rows of a box fill a leaf, like 16 tracked frames."""
    parts: dict[tuple[str, ...], SavedModel] = {}  # by their rows: equal frames have equal rows
    for number, box in keyframes.items():
        if box is not None and (model := _model(frames, number, box, settings, models)):
            parts[model.origins] = model
    return merge(parts.values(), force=True) if len(parts) > 1 else next(iter(parts.values()), None)


def _model(frames: VideoFrames, number: int, box: Box, settings: Settings, models: Path) -> SavedModel | None:
    """The model of one box, cached in a folder; None if tracking cannot start at the box."""
    file = models / f"{number}={','.join(map(str, box))}.safetensors"
    if not file.exists():
        tracker = MultiTracker(settings)
        try:
            tracker.init(frames[number], {UNNAMED: box})
        except BoxError:
            return None
        tracker.saved_model().save(file)
    return SavedModel.load(file)
