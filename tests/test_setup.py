"""The package that `pip install .` makes."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_wheel_contains_every_package_and_the_page(tmp_path):
    for name in ("pyproject.toml", "README.md", "LICENSE", "catstream"):
        (tmp_path / name).symlink_to(ROOT / name)
    build = "import setuptools.build_meta as build; build.build_wheel('dist')"
    done = subprocess.run([sys.executable, "-c", build], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert not re.findall(r".*(?:Warning|absent from|deprecated).*", done.stdout + done.stderr)
    (wheel,) = (tmp_path / "dist").glob("*-py3-none-any.whl")
    content = [*ROOT.glob("catstream/**/*.py"), *ROOT.glob("catstream/web/page/*"), ROOT / "catstream" / "py.typed"]
    assert {str(path.relative_to(ROOT)) for path in content} <= set(zipfile.ZipFile(wheel).namelist())
