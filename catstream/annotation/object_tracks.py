"""The track of an object in all frames of a video, as arrays."""

from __future__ import annotations

from collections.abc import Iterator

from catstream.annotation.keyframes import HIDDEN, KeyframeBox
from catstream.annotation.passes import box_of
from catstream.base.arrays import Bool, Float64
from catstream.messages.kinds import Check, Track

#: Probability from which a frame is checked.
CHECKED = 0.97


class ObjectTracks:
    """The tracks of an object by frame, in arrays: each `Track` is made when it is read.

    Attributes
    ----------
    unchecked : bool (frames,)
    """

    def __init__(
        self,
        name: str,
        keyframes: dict[int, KeyframeBox],
        times: Float64,
        boxes: Float64,
        probabilities: Float64,
        scores: Float64,
    ) -> None:
        self._name, self._keyframes, self._times = name, keyframes, times
        self._boxes, self._probabilities, self._scores = boxes, probabilities, scores
        self.unchecked: Bool = probabilities < CHECKED
        self.unchecked[[*keyframes]] = False

    def __len__(self) -> int:
        return len(self._times)

    def __iter__(self) -> Iterator[Track]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, frame: int) -> Track:
        frame = range(len(self))[frame]
        box, probability = box_of(self._boxes[frame]), float(self._probabilities[frame])
        return Track(
            *(
                frame,
                float(self._times[frame]),
                "absent" if box is None else "present",
                box,
                float(self._scores[frame]),
            ),
            model_version=0,
            object=self._name,
            doubtful=probability < CHECKED,
            checked=self.check(frame),
            probability=probability,
        )

    def check(self, frame: int) -> Check:
        if frame in self._keyframes:
            return HIDDEN if self._keyframes[frame] == HIDDEN else "keyframe"
        return "unchecked" if self.unchecked[frame] else "checked"
