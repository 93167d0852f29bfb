"""Descriptors: what computes the vectors of an image that a row holds beside HOG and colours.

A descriptor of another kind is a class beside `catstream.features.network.Network`, and a case of `descriptor_of`.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from catstream.base.settings import Settings
from catstream.errors import SettingsError


class Descriptor(Protocol):
    """A function of an image: the same image gives the same vectors, also in several threads at once.

    channels  length of a vector
    digest    identifies the function: rows of different ones cannot be compared
    """

    channels: int
    digest: str

    def __call__(self, planes: np.ndarray) -> np.ndarray:
        """Vectors of an image, one for each 16 x 16 pixels: uint8 (3, h, w) to float32 (h / 16, w / 16, channels).

        Blue, green and red; both sides are multiples of 16. Over many images the mean vector is 0, and the mean square
        length `catstream.features.network.ENERGY`, as the features of a cell vary.
        """


def descriptor_of(settings: Settings, digest: str = "") -> Descriptor | None:
    """The descriptor that the settings name, None if they name none.

    SettingsError if its file cannot be used, or its digest is not the one that is given; MissingExtraError if it needs
    a package that is not installed.
    """
    path = Path(settings.features.network)
    try:
        found = _opened(path, path.stat().st_mtime_ns) if settings.features.network else None
    except OSError as error:
        raise SettingsError(
            f"cannot read features.network={str(path)!r} ({error.strerror}): give one of `catstream network prepare`"
        ) from None
    if digest and digest != digest_of(found):
        raise SettingsError(
            f"the run was started with a network of digest {digest}, features.network={settings.features.network!r} "
            f"now has {digest_of(found) or 'none'}: continue with the same file"
        )
    return found


def digest_of(descriptor: Descriptor | None) -> str:
    """The digest of a descriptor, empty for none."""
    return "" if descriptor is None else descriptor.digest


@lru_cache(maxsize=2)
def _opened(path: Path, _: int) -> Descriptor:
    """The network in a file that was modified at a time."""
    from catstream.features.network import Network

    return Network(path)
