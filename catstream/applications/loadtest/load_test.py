"""A load test: a single run, or the search for the highest rate at which the limits are met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from catstream.applications.loadtest.camera import Camera, render
from catstream.applications.loadtest.limits import Limit, violations
from catstream.applications.loadtest.plan import Plan
from catstream.applications.loadtest.run import Report, Result, run
from catstream.video import rendered

_LEAST, _MOST = 0.5, 1000.0  # frames per second
_PRECISION = 0.05  # maximum relative error of the highest rate


@dataclass(slots=True)
class LoadTest:
    """The runs of a load test.

    limits        the limits of each run
    is_search     whether the highest rate is searched for
    results       all runs, in order; empty if it was interrupted before the first measurement
    highest_rate  the highest rate that meets the limits; None if there was no search, or no such rate
    interrupted   whether it was interrupted
    """

    limits: list[Limit]
    is_search: bool
    results: list[Result] = field(default_factory=list)
    highest_rate: float | None = None
    interrupted: bool = False

    @property
    def result(self) -> Result:
        """The decisive run: the one with the highest rate that meets the limits, or the last one if none does."""
        held = [result for result in self.results if not violations(self.limits, result)]
        return max(held, key=lambda result: result.plan.rate, default=self.results[-1])

    @property
    def violations(self) -> list[str]:
        """The reasons why the load test has failed, one line each."""
        if not self.is_search:
            return [line for result in self.results for line in violations(self.limits, result)]
        if self.highest_rate is None and not self.interrupted:
            lowest = self.results[-1].plan.rate
            return [f"no rate meets {', '.join(map(str, self.limits))}: the lowest tried was {lowest:g}"]
        return []


def run_load_test(
    plan: Plan,
    limits: list[Limit],
    *,
    find: bool,
    report: Report = lambda *_: None,
    done: Callable[[Result], None] = lambda _: None,
) -> LoadTest:
    """Run a load test. After Ctrl-C, the measurements so far are returned.

    Parameters
    ----------
    find : search for the highest rate that meets the limits, beginning with that of the plan
    report : function that is called with the progress
    done : function that is called after each run
    """
    load_test, images = LoadTest(limits, find), rendered.FRAMES if find else min(plan.frames, rendered.FRAMES)

    def holds(rate: float) -> bool:
        result = run(replace(plan, rate=rate), camera, report)
        load_test.results.append(result)
        done(result)
        if result.interrupted:
            raise KeyboardInterrupt
        return not violations(limits, result)

    try:
        video = render(plan, images, lambda count: report("rendering", count / images, f"{count} of {images} frames"))
        with Camera(video, plan.streams) as camera:
            if find:
                load_test.highest_rate = find_highest_rate(plan.rate, holds)
            else:
                holds(plan.rate)
    except KeyboardInterrupt:
        load_test.interrupted = True
    return load_test


def find_highest_rate(start: float, holds: Callable[[float], bool]) -> float | None:
    """Return the highest rate for which `holds` is true, to within 5 %; None if it is false even for the lowest rate.

    The rate is doubled or halved from `start` until the limit is between two rates, and then bisected. `holds` is
    called once for each rate, so random variation of its result affects the answer.

    >>> find_highest_rate(25.0, lambda rate: rate <= 42)
    40.6
    """
    low, high, rate = 0.0, float("inf"), min(max(start, _LEAST), _MOST)
    while rate not in (low, high) and high - low > _PRECISION * low:
        if holds(rate):
            low = rate
        else:
            high = rate
        if low == 0.0:
            rate = max(round(high / 2, 1), _LEAST)
        elif high == float("inf"):
            rate = min(round(2 * low, 1), _MOST)
        else:
            rate = round((low + high) / 2, 1)
    return low or None
