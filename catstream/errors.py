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
    """The name of an object is not valid, is in use, or belongs to no object; or there are too many objects."""


class FrameError(CatstreamError, ValueError):
    """An array is not a frame: its type, shape, size or range of values is wrong. Or its time is not finite."""


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
    """No message arrived from a pipeline within the time-out."""


class CommandRejectedError(ServiceError):
    """A running pipeline did not carry out a command; the message has the reason."""


class FleetError(ServiceError):
    """A fleet cannot do what was asked for; the message names the stream or the node."""


class FencedError(FleetError):
    """Another holder has claimed a stream since; this one may not write its state any more, and has to stop."""


class StoreError(FleetError):
    """The store of a fleet is unreachable, full or damaged. The call may be repeated later."""


@contextmanager
def errors_in(where: str, kind: type[CatstreamError]) -> Iterator[None]:
    """A block whose errors become errors of this kind, with the place before their text."""
    try:
        yield
    except CatstreamError as error:
        raise kind(f"{where}: {error}") from None


def require_linux() -> None:
    """Raise ServiceError on another system, which lacks what the processes of a pipeline need."""
    if sys.platform != "linux":
        raise ServiceError(
            "a pipeline requires Linux: use catstream.Tracker, MultiTracker, annotate and find, or the commands batch, "
            "annotate, find, evaluate, export and report"
        )


def require_fleet() -> None:
    """Raise MissingExtraError if a package of the extra `fleet` is not installed; none is imported."""
    if missing := [module for module in ("ray", "obstore") if find_spec(module) is None]:
        raise MissingExtraError(
            f"a fleet needs packages that are not installed ({', '.join(missing)}): {install_command('fleet')}"
        )


def install_command(extra: str) -> str:
    """Return the command that adds an extra to the catstream that is installed in this environment.

    It works for a checkout too: pip keeps the installed catstream and adds the packages of the extra.
    """
    beside = Path(sys.executable).with_name("pip")
    pip = "pip" if shutil.which("pip") == str(beside) else f"{shlex.quote(sys.executable)} -m pip"
    return f'{pip} install "catstream[{extra}]"'
