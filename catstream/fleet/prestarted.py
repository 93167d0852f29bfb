"""What a worker of Ray imports while it is idle, and waits for a stream (RAY_preload_python_modules).

It imports all that the actor of a stream needs, and starts the start server of its node, before a stream needs them.
Elsewhere, as where a tool imports all modules, it does nothing, and does not import Ray either.
"""

from __future__ import annotations

import sys

from catstream.fleet.controller import warm

__all__: list[str] = []

if (ray := sys.modules.get("ray")) is not None and ray.is_initialized():
    warm()
