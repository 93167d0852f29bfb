"""The plan of a load test."""

from __future__ import annotations

from dataclasses import dataclass, field

from catstream.applications.loadtest import crowd
from catstream.errors import SettingsError
from catstream.messages.names import check_count, counted
from catstream.settings import Settings
from catstream.video import rendered


@dataclass(frozen=True, slots=True)
class Plan:
    """The parameters of one run.

    streams           number of pipelines, each of three processes
    objects           number of objects that each pipeline tracks, those of `catstream demo`
    subscribers       number of subscribers to the tracks of each stream
    slow_subscribers  number of those that are slow; half of these are frozen instead
    rate              frames per second of each stream, whether or not the pipeline keeps up
    duration          seconds
    size              (width, height) of a frame in pixels
    settings          settings of all pipelines

    Raises
    ------
    SettingsError
        If the parameters contradict one another, or a setting is not possible in a load test.
    ObjectError
        If there are too many objects.
    """

    streams: int = 1
    objects: int = 1
    subscribers: int = 0
    slow_subscribers: int = 0
    rate: float = 25.0
    duration: float = 10.0
    size: tuple[int, int] = rendered.SIZE
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        if self.slow_subscribers > self.subscribers:
            raise SettingsError(
                f"{self.slow_subscribers} of {self.subscribers} subscribers cannot be slow: "
                "give more, or fewer slow ones"
            )
        if self.frames < 1:
            raise SettingsError(
                f"no frame is due in {self.duration:g} s at {self.rate:g} frames/s: give a higher rate or more seconds"
            )
        if self.objects > (most := len(crowd.NAMES)):
            raise SettingsError(
                f"the video of a load test shows at most {most} objects, not {self.objects}: give fewer"
            )
        check_count(self.objects, self.settings.run.objects_most)
        if self.settings.run.lockstep:
            raise SettingsError("the frames of a load test do not wait for models: leave out lockstep")
        if self.settings.run.endpoint:
            raise SettingsError("each stream of a load test has an endpoint of its own: leave out endpoint")

    def __str__(self) -> str:
        objects = f", {self.objects} objects" if self.objects > 1 else ""
        size = f"{self.size[0]}x{self.size[1]} pixels"
        return f"{counted(self.streams, 'stream')} of {size}{objects}, {self.rate:g} frames/s due in each"

    @property
    def frozen(self) -> int:
        """Number of the slow subscribers that are frozen."""
        return self.slow_subscribers // 2

    @property
    def frames(self) -> int:
        """Number of frames of each stream."""
        return round(self.rate * self.duration)
