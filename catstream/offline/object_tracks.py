"""The track of an object in all frames of a video, as arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from catstream.base.arrays import Bool, Float64
from catstream.offline.keyframes import HIDDEN, KeyframeBox
from catstream.offline.passes import box_of
from catstream.wire.messages import Check, State, Track

#: Minimum probability of a checked frame.
CHECKED = 0.97


@dataclass(frozen=True, eq=False)
class ObjectTracks:
    """The tracks of an object by frame, stored as arrays; each `Track` is created on access."""

    name: str
    keyframes: dict[int, KeyframeBox]
    times: Float64
    boxes: Float64
    probabilities: Float64
    scores: Float64

    @cached_property
    def unchecked(self) -> Bool:
        """Mask of the unchecked frames, bool (frames,)."""
        unchecked = self.probabilities < CHECKED
        unchecked[[*self.keyframes]] = False
        return unchecked

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Track]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, frame: int) -> Track:
        frame = range(len(self))[frame]
        box, chance, check = box_of(self.boxes[frame]), float(self.probabilities[frame]), self.check(frame)
        state: State = "absent" if box is None else "present"
        track = frame, float(self.times[frame]), state, box, float(self.scores[frame])
        return Track(
            *track, model_version=0, object=self.name, doubtful=chance < CHECKED, checked=check, probability=chance
        )

    def check(self, frame: int) -> Check:
        if frame in self.keyframes:
            return HIDDEN if self.keyframes[frame] == HIDDEN else "keyframe"
        return "unchecked" if self.unchecked[frame] else "checked"
