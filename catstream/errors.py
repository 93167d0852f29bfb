"""The exceptions of catstream, and the check for the packages of an extra.

Every message says what was expected, what was received, and what to do. The
command line prints it as one line and exits with 1; a program catches
`CatstreamError` or one of its subclasses.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path


class CatstreamError(Exception):
    """Base class of all errors that catstream raises on purpose."""


class SettingsError(CatstreamError, ValueError):
    """A setting does not exist, or has an invalid value."""


class MissingExtraError(CatstreamError, ImportError):
    """An optional dependency is not installed; the message has the command that installs it."""


class BoxError(CatstreamError, ValueError):
    """A box is outside the frame, far larger than the frame, has no area, or is not four finite numbers."""


class ObjectError(CatstreamError, ValueError):
    """The name of an object is invalid, in use or unknown; or there are too many objects."""


class FrameError(CatstreamError, ValueError):
    """An array is not a valid frame (type, shape, size, range of values), or its time is not finite."""


class VideoError(CatstreamError):
    """A source of frames cannot be read, or results cannot be written."""


class ProtocolError(CatstreamError, ValueError):
    """A message does not conform to the protocol of its channel, or a file is damaged."""


class ServiceError(CatstreamError):
    """A process of the pipeline failed or cannot start."""


class MissingFileError(ServiceError, FileNotFoundError):
    """There is no file of the given name."""


class StreamRewoundError(ServiceError):
    """A restarted receiver is behind the position that it had acknowledged; its sender cannot retransmit the rest."""


class SilenceError(ServiceError, TimeoutError):
    """No message arrived from a pipeline before the timeout."""


class CommandRejectedError(ServiceError):
    """A running pipeline rejected a command; the message has the reason."""


class FleetError(ServiceError):
    """A fleet cannot execute a request; the message names the stream or the node."""


class FencedError(FleetError):
    """Another process has claimed a stream; this one must stop, and may not write the state of the stream."""


class StoreError(FleetError):
    """The store of a fleet is unreachable, full or damaged. The call may be repeated later."""


@contextmanager
def errors_in(where: str, kind: type[CatstreamError]) -> Iterator[None]:
    """Convert the errors of a block to errors of this kind, prefixed with `where`."""
    try:
        yield
    except CatstreamError as error:
        raise kind(f"{where}: {error}") from None


def require_linux() -> None:
    """Raise ServiceError unless this is Linux, which the processes of a pipeline require."""
    if sys.platform != "linux":
        raise ServiceError(
            "a pipeline requires Linux: use catstream.Tracker, MultiTracker, annotate and find, or the commands batch, "
            "annotate, find, evaluate, export and report"
        )


def require_fleet() -> None:
    """Raise MissingExtraError if a package of the extra `fleet` is not installed, without importing it."""
    if missing := [module for module in ("ray", "obstore") if find_spec(module) is None]:
        raise MissingExtraError(
            f"a fleet needs packages that are not installed ({', '.join(missing)}): {install_command('fleet')}"
        )


def install_command(extra: str) -> str:
    """Return the command that installs an extra in this environment.

    It also works for a checkout: pip keeps the installed catstream and adds the packages of the extra.
    """
    own = Path(sys.executable).with_name("pip")
    pip = "pip" if shutil.which("pip") == str(own) else f"{shlex.quote(sys.executable)} -m pip"
    return f'{pip} install "catstream[{extra}]"'
