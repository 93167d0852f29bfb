"""The sequences that the default settings were tuned on, and those that are held out: `groups.json`.

TUNED  the defaults were tuned on these twenty, so their measures are biased upwards
CHECK  no longer used for tuning; three of the fifteen are in the tuning set too, twelve never were
"""

from __future__ import annotations

import json
from pathlib import Path

_NAMES = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
TUNED, CHECK = frozenset(_NAMES["tuned"]), frozenset(_NAMES["check"])
