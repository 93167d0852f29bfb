"""What a load test is to do."""

from __future__ import annotations

from dataclasses import dataclass, field

from catstream.errors import SettingsError
from catstream.settings import Settings
from catstream.video import demo

__all__ = ["Plan"]


@dataclass(frozen=True, slots=True)
class Plan:
    """One run.

    streams      pipelines side by side, each of three processes
    subscribers  of the tracks of each stream
    slow         of them slow, and every other one of these frozen
    rate         frames a second of each stream, due whether or not the pipeline keeps up
    duration     seconds
    size         (width, height) of a frame, pixels
    chaos        whether processes are killed meanwhile
    settings     of all pipelines; the seed is that of the chaos too

    Raises
    ------
    SettingsError
        For settings that the streams cannot have.
    """

    streams: int = 1
    subscribers: int = 0
    slow: int = 0
    rate: float = 25.0
    duration: float = 10.0
    size: tuple[int, int] = demo.SIZE
    chaos: bool = False
    settings: Settings = field(default_factory=Settings)

    def __post_init__(self) -> None:
        if self.slow > self.subscribers:
            raise SettingsError(
                f"{self.slow} of {self.subscribers} subscribers cannot be slow: attach more, or fewer slow"
            )
        if self.frames < 1:
            raise SettingsError(
                f"no frame is due in {self.duration:g} s at {self.rate:g} frames/s: give a higher rate or more seconds"
            )
        if self.settings.run.lockstep:
            raise SettingsError("the frames of a load test do not wait: leave lockstep away")
        if self.settings.run.endpoint:
            raise SettingsError("each stream of a load test meets in a folder of its own: leave endpoint away")

    def __str__(self) -> str:
        streams = f"{self.streams} streams" if self.streams > 1 else "1 stream"
        return f"{streams} of {self.size[0]}x{self.size[1]} pixels, {self.rate:g} frames/s due in each"

    @property
    def frozen(self) -> int:
        """Subscribers that are frozen, of those that are slow."""
        return self.slow // 2

    @property
    def frames(self) -> int:
        """Frames of each stream."""
        return round(self.rate * self.duration)
