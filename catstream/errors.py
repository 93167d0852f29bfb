"""What can go wrong, by name.

Every message says what was expected, what came, and what to do. The command
line prints it as one line and exits with 1; a program catches
`CatstreamError`, or one of its kinds.
"""

__all__ = [
    "BoxError",
    "CatstreamError",
    "FrameError",
    "MissingExtraError",
    "ProtocolError",
    "RecordingError",
    "RefusedError",
    "ServiceError",
    "SetBackError",
    "SettingsError",
    "SilenceError",
    "VideoError",
]


class CatstreamError(Exception):
    """Any error that catstream raises on purpose."""


class SettingsError(CatstreamError, ValueError):
    """A setting that does not exist, or a value it cannot take."""


class MissingExtraError(CatstreamError, ImportError):
    """An optional dependency that is not installed; says how to install it."""


class BoxError(CatstreamError, ValueError):
    """A box that is not in the frame or far larger than it, has no area, or is not a number."""


class FrameError(CatstreamError, ValueError):
    """An array that is not a frame: of another type, shape or size, or with values that are no brightness."""


class VideoError(CatstreamError):
    """A source of frames, or a place for results, that cannot be used."""


class ProtocolError(CatstreamError, ValueError):
    """A message that is not what the channel carries.

    reason  what is wrong with it, in one word: health counts the refused by it
    """

    def __init__(self, text: str, reason: str = "content") -> None:
        super().__init__(text)
        self.reason = reason


class RecordingError(CatstreamError):
    """A recording that cannot be written or read, or that is not whole enough."""


class ServiceError(CatstreamError):
    """A process of the pipeline that failed, or that cannot start."""


class SetBackError(ServiceError):
    """A receiver that needs messages once more that its sender does not have any more: its disk lost them."""


class SilenceError(ServiceError, TimeoutError):
    """A pipeline from which nothing came in the time given."""


class RefusedError(ServiceError):
    """A command that a running pipeline did not carry out; says why."""
