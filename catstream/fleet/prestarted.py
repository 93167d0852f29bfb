"""What a worker of Ray imports while it is idle, and waits for a stream (RAY_preload_python_modules).

It imports all that the actor of a stream needs, and starts the start server of its node, before a stream needs them.
"""

from __future__ import annotations

from catstream.fleet.controller import warm

__all__: list[str] = []


def _is_worker() -> bool:
    import ray

    return ray.is_initialized()


if _is_worker():  # not where a tool imports all modules
    warm()
