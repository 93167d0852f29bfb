"""Adds the folder of the modules that all benchmarks share to the path of imports, for a script in this folder."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))
