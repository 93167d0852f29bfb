"""A load test: a single run, or the search for the highest rate at which the limits are met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from catstream.applications.loadtest.camera import Camera
from catstream.applications.loadtest.limits import Limit, violations
from catstream.applications.loadtest.plan import Plan
from catstream.applications.loadtest.run import Result, Status, run
from catstream.applications.loadtest.search import find_highest_rate
from catstream.video import demo

__all__ = ["LoadTest", "Step", "run_load_test"]


@dataclass(frozen=True, slots=True)
class Step:
    """One run and its violations of the limits."""

    result: Result
    violations: list[str]

    @property
    def rate(self) -> float:
        """Frames per second that were due."""
        return self.result.plan.rate

    @property
    def followed(self) -> float:
        """Frames per second that were tracked in the worst stream."""
        return min(stream.rate(self.rate) for stream in self.result.streams)


@dataclass(slots=True)
class LoadTest:
    """The runs of a load test.

    limits        the limits of each run
    is_search     whether the highest rate is searched for
    steps         all runs, in order; empty if it was interrupted before the first measurement
    highest_rate  the highest rate that meets the limits; None if there was no search, or no such rate
    interrupted   whether it was interrupted
    """

    limits: list[Limit]
    is_search: bool
    steps: list[Step] = field(default_factory=list)
    highest_rate: float | None = None
    interrupted: bool = False

    @property
    def result(self) -> Result:
        """The decisive run: the one with the highest rate that meets the limits, or the last one if none does."""
        held = [step for step in self.steps if not step.violations]
        return max(held, key=lambda step: step.rate, default=self.steps[-1]).result

    @property
    def violations(self) -> list[str]:
        """The reasons why the load test has failed, one line each."""
        if not self.is_search:
            return [line for step in self.steps for line in step.violations]
        if self.highest_rate is None and not self.interrupted:
            return [f"no rate meets {', '.join(map(str, self.limits))}: the lowest tried was {self.steps[-1].rate:g}"]
        return []


def run_load_test(
    plan: Plan,
    limits: list[Limit],
    *,
    find: bool,
    report_status: Callable[[Status], None] = lambda _: None,
    step_done: Callable[[Step], None] = lambda _: None,
) -> LoadTest:
    """Run a load test. After Ctrl-C, the measurements so far are returned.

    Parameters
    ----------
    find : search for the highest rate that meets the limits, beginning with that of the plan
    report_status : function that is called about ten times a second
    step_done : function that is called after each run
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
        with Camera(plan.streams, plan.size, pictures, plan.objects) as camera:
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
