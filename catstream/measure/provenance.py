"""The provenance of measured figures: version, date, command and machine."""

from __future__ import annotations

import os
import platform
import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from catstream.base.addresses import without_passwords
from catstream.base.threads import cores


def provenance(words: Sequence[str]) -> dict[str, Any]:
    """Return the provenance of the figures of a command as a JSON object, without host name and passwords."""
    text = ""
    with suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    name = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    machine = {
        "processor": name[1] if name else platform.machine(),
        "cores": cores(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9),
        "system": platform.system(),
        "python": platform.python_version(),
    }
    date, command = datetime.now(UTC).isoformat(" ", "seconds"), without_passwords(shlex.join(words))
    return {"version": version("catstream"), "date": date, "command": command, "machine": machine}
