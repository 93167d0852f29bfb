"""Compares two results of a load test that `catstream loadtest --json` wrote."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from catstream.errors import SettingsError


class Change(NamedTuple):
    """A figure of two results.

    name           name of a limit, `cores` or `memory` of a stream, or the searched parameter
    before, after  its values, in seconds, bytes, or a share from 0 to 1
    worse          relative change for the worse, negative if it is better; infinite if `before` is 0
    is_regression  whether `worse` exceeds the tolerance
    """

    name: str
    before: float
    after: float
    worse: float
    is_regression: bool


def read_result(path: Path) -> dict[str, Any]:
    """Read the JSON file of a load test; SettingsError if it is invalid."""
    try:
        result: dict[str, Any] = json.loads(path.read_bytes())
        _ = result["plan"]["rate"], result["figures"]["p99"], result["find"], result["highest"], result["settings"]
    except (OSError, ValueError, TypeError, KeyError):
        raise SettingsError(
            f"{path} is not a result of a load test: pass a file that `catstream loadtest --json` of this version wrote"
        ) from None
    return result


def compare(before: dict[str, Any], after: dict[str, Any], tolerance: float) -> list[Change]:
    """Return the figures of two results of the same plan.

    p99.9 and max are never a regression, because they are latencies of single frames. For two searches, the highest
    numbers are compared. Raises SettingsError for different plans.

    tolerance : relative change for the worse that is not a regression
    """
    find = before["find"]
    plans = [
        {**each["plan"], **{key: each[key] for key in ("settings", "interrupted", "find")}} for each in (before, after)
    ]
    differ = [key for key in sorted(plans[0].keys() | plans[1].keys()) if plans[0].get(key) != plans[1].get(key)]
    if names := [key for key in differ if key != find]:
        raise SettingsError(
            f"the results have different plans ({', '.join(names)}): {before['command']!r} and {after['command']!r}; "
            "repeat one load test like the other"
        )
    changes = []
    for name in [f"highest {find}"] if find else before["figures"]:
        old, new = (each["highest"] or 0 if find else each["figures"].get(name, 0.0) for each in (before, after))
        loss = old - new if find or name == "success" else new - old
        worse = loss / old if old else math.copysign(math.inf, loss) if loss else 0.0
        changes.append(Change(name, old, new, worse, worse > tolerance and not name.endswith(("p99.9", "max"))))
    return changes
