"""Descriptors: functions of an image whose vectors a row contains beside HOG and colours.

To add another kind, write a class beside `catstream.features.network.Network` and a case in `descriptor_of`.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from catstream.base.settings import Settings
from catstream.errors import SettingsError


class Descriptor(Protocol):
    """A function of an image, deterministic and safe to call from several threads.

    channels  length of a vector
    digest    identifies the function: rows of different ones cannot be compared
    """

    channels: int
    digest: str

    def __call__(self, planes: np.ndarray) -> np.ndarray:
        """Vectors of an image, one per 16 x 16 pixels: uint8 (3, h, w) to float32 (h / 16, w / 16, channels).

        The planes are blue, green and red; both sides are multiples of 16. Over many images, the mean vector is 0 and
        the mean squared norm `catstream.features.network.ENERGY`, the variance of the features of a cell.
        """


def descriptor_of(settings: Settings, digest: str = "") -> Descriptor | None:
    """The descriptor of the setting `features.network`, None if that is empty.

    SettingsError if its file cannot be used, or if `digest` is not empty and differs from its own; MissingExtraError if
    it needs a package that is not installed.
    """
    path = Path(settings.features.network)
    try:
        descriptor = _load(path, path.stat().st_mtime_ns) if settings.features.network else None
    except OSError as error:
        raise SettingsError(
            f"cannot read features.network={str(path)!r} ({error.strerror}): pass a file of `catstream network prepare`"
        ) from None
    if digest and digest != digest_of(descriptor):
        raise SettingsError(
            f"the run was started with a network of digest {digest}, features.network={settings.features.network!r} "
            f"now has {digest_of(descriptor) or 'none'}: continue with the same file"
        )
    return descriptor


def digest_of(descriptor: Descriptor | None) -> str:
    """The digest of a descriptor, empty for none."""
    return "" if descriptor is None else descriptor.digest


@lru_cache(maxsize=2)
def _load(path: Path, _: int) -> Descriptor:
    """Load a network from a file; the second argument, its modification time, invalidates the cache."""
    from catstream.features.network import Network

    return Network(path)
