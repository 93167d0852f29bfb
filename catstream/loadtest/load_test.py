"""A whole load test: one run, or one for each rate until the highest that holds is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from catstream.loadtest.camera import Camera
from catstream.loadtest.limits import Limit, violations
from catstream.loadtest.plan import Plan
from catstream.loadtest.run import Result, Status, run
from catstream.loadtest.search import find_highest_rate
from catstream.video import demo

__all__ = ["LoadTest", "Step", "run_load_test"]


@dataclass(frozen=True, slots=True)
class Step:
    """One run, and what it broke."""

    result: Result
    violations: list[str]

    @property
    def rate(self) -> float:
        """Frames a second that were due."""
        return self.result.plan.rate

    @property
    def followed(self) -> float:
        """Frames a second that were followed, of the worst stream."""
        return min(stream.rate(self.rate) for stream in self.result.streams)


@dataclass(slots=True)
class LoadTest:
    """What was run.

    is_search     whether a rate was looked for
    steps        all runs, in order; empty where it was stopped before the first was measured
    highest_rate        the highest rate that holds; None where none was looked for, or highest_rate
    interrupted  whether it was stopped before its end
    """

    limits: list[Limit]
    is_search: bool
    steps: list[Step] = field(default_factory=list)
    highest_rate: float | None = None
    interrupted: bool = False

    @property
    def result(self) -> Result:
        """The run that counts: of a search, that with the highest rate that held; the last one where none did."""
        held = [step for step in self.steps if not step.violations]
        return max(held, key=lambda step: step.rate, default=self.steps[-1]).result

    @property
    def violations(self) -> list[str]:
        """Why it is no success, a line each."""
        if not self.is_search:
            return [line for step in self.steps for line in step.violations]
        if self.highest_rate is None and not self.interrupted:
            return [f"no rate holds {', '.join(map(str, self.limits))}: the last one, {self.steps[-1].rate:g}, did not"]
        return []


def run_load_test(
    plan: Plan,
    limits: list[Limit],
    *,
    find: bool,
    report_status: Callable[[Status], None] = lambda _: None,
    step_done: Callable[[Step], None] = lambda _: None,
) -> LoadTest:
    """Run a load test. Ctrl-C ends it: what was measured so far is returned.

    Parameters
    ----------
    find : look for the highest rate that holds, from that of the plan on
    report_status : called ten times a second or so
    step_done : called after each run
    """
    load_test = LoadTest(limits, find)
    pictures = demo.FRAMES if find else min(plan.frames, demo.FRAMES)

    def holds(rate: float) -> bool:
        result = run(replace(plan, rate=rate), camera, report_status)
        load_test.steps.append(Step(result, violations(limits, result)))
        step_done(load_test.steps[-1])
        if result.interrupted:
            raise KeyboardInterrupt
        return not load_test.steps[-1].violations

    try:
        with Camera(plan.streams, plan.size, pictures) as camera:
            camera.render(
                lambda count: report_status(Status("rendering", count / pictures, f"{count} of {pictures} frames"))
            )
            if find:
                load_test.highest_rate = find_highest_rate(plan.rate, holds)
            else:
                holds(plan.rate)
    except KeyboardInterrupt:
        load_test.interrupted = True
    return load_test
