"""Optional dependencies: only a fleet needs them."""

import subprocess
import sys

import pytest

from catstream.errors import MissingExtraError, require_fleet

#: Blocks the modules of the extra, then imports all that tracking a video needs.
BASE = """
import sys
for module in ("ray", "obstore"):
    sys.modules[module] = None
import catstream
catstream.Tracker, catstream.Pipeline, catstream.subscribe, catstream.control
from catstream.cli import COMMANDS, load_command
import catstream.processes.by_hand
import catstream.measure.accuracy
for name in COMMANDS:
    load_command(name)
"""


def test_tracking_and_the_help_of_every_command_need_no_extra():
    subprocess.run([sys.executable, "-P", "-c", BASE], check=True)


def test_missing_extra_is_an_error_with_the_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r'a fleet needs packages .* \(ray\): .* "catstream\[fleet\]"'):
        require_fleet()
