"""A whole load test: one run, or one for each rate until the highest that holds is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from catstream.loadtest.camera import Camera
from catstream.loadtest.limits import Limit, broken
from catstream.loadtest.plan import Plan
from catstream.loadtest.run import News, Result, run
from catstream.loadtest.search import highest
from catstream.video import demo

__all__ = ["Step", "Trial", "hold"]


@dataclass(frozen=True, slots=True)
class Step:
    """One run, and what it broke."""

    result: Result
    broken: list[str]

    @property
    def rate(self) -> float:
        """Frames a second that were due."""
        return self.result.plan.rate

    @property
    def followed(self) -> float:
        """Frames a second that were followed, of the worst stream."""
        return min(stream.rate(self.rate) for stream in self.result.streams)


@dataclass(slots=True)
class Trial:
    """What was run.

    searched     whether a rate was looked for
    steps        all runs, in order; empty where it was stopped before the first was measured
    found        the highest rate that holds; None where none was looked for, or found
    interrupted  whether it was stopped before its end
    """

    limits: list[Limit]
    searched: bool
    steps: list[Step] = field(default_factory=list)
    found: float | None = None
    interrupted: bool = False

    @property
    def result(self) -> Result:
        """The run that counts: of a search, that with the highest rate that held; the last one where none did."""
        held = [step for step in self.steps if not step.broken]
        return max(held, key=lambda step: step.rate, default=self.steps[-1]).result

    @property
    def broken(self) -> list[str]:
        """Why it is no success, a line each."""
        if not self.searched:
            return [line for step in self.steps for line in step.broken]
        if self.found is None and not self.interrupted:
            return [f"no rate holds {', '.join(map(str, self.limits))}: the last one, {self.steps[-1].rate:g}, did not"]
        return []


def hold(
    plan: Plan,
    limits: list[Limit],
    *,
    find: bool,
    tell: Callable[[News], None] = lambda _: None,
    tried: Callable[[Step], None] = lambda _: None,
) -> Trial:
    """Run a load test. Ctrl-C ends it: what was measured so far is returned.

    Parameters
    ----------
    find : look for the highest rate that holds, from that of the plan on
    tell : called ten times a second or so
    tried : called after each run
    """
    trial = Trial(limits, find)
    pictures = demo.FRAMES if find else min(plan.frames, demo.FRAMES)

    def holds(rate: float) -> bool:
        result = run(replace(plan, rate=rate), camera, tell)
        trial.steps.append(Step(result, broken(limits, result)))
        tried(trial.steps[-1])
        if result.interrupted:
            raise KeyboardInterrupt
        return not trial.steps[-1].broken

    try:
        with Camera(plan.streams, plan.size, pictures) as camera:
            camera.render(lambda count: tell(News("rendering", count / pictures, f"{count} of {pictures} frames")))
            if find:
                trial.found = highest(plan.rate, holds)
            else:
                holds(plan.rate)
    except KeyboardInterrupt:
        trial.interrupted = True
    return trial
