"""Runs Ray's command line as the child of a keeper: `python -P -m catstream.fleet.launch PARENT start ...`.

It ends if its parent, whose process id is the first argument, ends in any way; Ray ends its own processes then.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from importlib import import_module

__all__ = ["main"]

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run the command of Ray in the arguments."""
    parent = int(sys.argv.pop(1))
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it ended before the call
        sys.exit(1)

    from ray.scripts.scripts import main as ray

    from catstream.fleet.cluster import stay_on_loopback

    stay_on_loopback()
    _close_ports()
    ray()


def _close_ports() -> None:
    """Make Ray behave as if only its own package were installed.

    With grpcio or the packages of `ray[default]` it would open ports for its client, job submission and metrics, which
    a fleet does not use.
    """
    missing = ImportError("a fleet does not use it")
    for module, name in (
        ("ray.scripts.scripts", "get_ray_client_dependency_error"),
        ("ray._private.utils", "get_dashboard_dependency_error"),
    ):
        setattr(import_module(module), name, lambda: missing)


if __name__ == "__main__":
    main()
