"""Optional dependencies: the extras of pyproject.toml, and the error for one that is not installed."""

from __future__ import annotations

import shlex
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

from catstream.errors import MissingExtraError

__all__ = ["EXTRAS", "install_command", "require_extra"]

#: Extra -> the feature that needs it, and the modules that the feature imports.
EXTRAS = {
    "view": ("the web page", ("prometheus_client", "starlette", "uvicorn")),
    "loadtest": ("the load test", ("hdrh", "psutil")),
    "parquet": ("a Parquet file", ("pyarrow",)),
    "supervision": ("to_supervision", ("supervision",)),
    "fleet": ("a fleet", ("fsspec", "ray")),
    "s3": ("a store on S3", ("s3fs",)),
    "mot": ("the accuracy of several objects", ("motmetrics",)),
}


def require_extra(extra: str) -> None:
    """Check that the modules of an extra are installed, without importing them.

    Raises
    ------
    MissingExtraError
        If one of them is not installed; the message has the command that installs the extra.
    """
    feature, modules = EXTRAS[extra]
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise MissingExtraError(
            f"{feature} needs packages that are not installed ({', '.join(missing)}): {install_command(extra)}"
        )


def install_command(extra: str) -> str:
    """Return the command that adds an extra to the catstream that is installed in this environment.

    It works for a checkout too: pip keeps the installed catstream and adds the packages of the extra.
    """
    beside = Path(sys.executable).with_name("pip")
    pip = "pip" if shutil.which("pip") == str(beside) else f"{shlex.quote(sys.executable)} -m pip"
    return f'{pip} install "catstream[{extra}]"'
