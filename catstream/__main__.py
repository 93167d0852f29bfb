"""The command `catstream`, also as `python -m catstream`."""

from __future__ import annotations

import os
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line; Ctrl-C during its imports, too, ends it without a traceback."""
    try:
        from catstream.cli import main as run
    except KeyboardInterrupt:
        os.write(2, b"stopped\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
