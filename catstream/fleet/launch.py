"""Runs Ray's command line as the child of a keeper: `python -P -m catstream.fleet.launch PARENT start ...`.

It ends if its parent, whose process id is the first argument, ends in any way; Ray ends its own processes then.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

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
    ray()


if __name__ == "__main__":
    main()
