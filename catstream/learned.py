"""A saved model: with it, the object is found again in another video, and training continues.

The file has the newest model, the sample of the coreset trees that it was trained on, and the last box.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from catstream import storage
from catstream.box import Box
from catstream.errors import ProtocolError, ServiceError
from catstream.messages import Model, Sample
from catstream.packing import pack, unpack
from catstream.storage import Arrays, Metadata
from catstream.wire.checks import check_message

__all__ = ["Learned"]

_KIND = "learned 2"  # and the version of what the file holds


@dataclass(frozen=True, slots=True)
class Learned:
    """A model and the sample that it was trained on.

    model   the newest model; loaded from a file, its frame is 0
    sample  the sample that the model was trained on
    box     last box of the object, in pixels: a search begins with its size
    """

    model: Model
    sample: Sample
    box: Box

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one safetensors file, atomically.

        Raises
        ------
        ServiceError
            If it cannot be written.
        """
        sample_arrays, sample_metadata = pack(self.sample, "sample")
        model_arrays, model_metadata = pack(self.model, "model")
        metadata: Metadata = {"kind": _KIND, "box": list(self.box), "sample": sample_metadata, "model": model_metadata}
        try:
            storage.write(path, sample_arrays | model_arrays, metadata)
        except OSError as error:
            raise ServiceError(f"cannot write {str(path)!r} ({error.strerror}): give another file") from None

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read what `save` wrote.

        Raises
        ------
        ServiceError
            If it does not exist.
        ProtocolError
            If it is damaged, or another file.
        """
        if not Path(path).is_file():
            raise ServiceError(f"there is no saved model {str(path)!r}: `catstream save` writes one")
        arrays, metadata = storage.read(path)
        try:
            if metadata.get("kind") != _KIND:
                raise ValueError(f"it is of kind {metadata.get('kind')!r}, not {_KIND!r}")
            learned = cls._of(arrays, metadata)
            for message in (learned.model, learned.sample):
                check_message(message)
            x, y, w, h = learned.box
            if not (np.isfinite((x, y)).all() and 0 < w < np.inf and 0 < h < np.inf):
                raise ValueError(f"its box is {learned.box}")
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise ProtocolError(f"{path} is not a saved model ({error}): `catstream save` writes one") from None
        return learned

    @classmethod
    def _of(cls, arrays: Arrays, metadata: Metadata) -> Self:
        sample = unpack(Sample, arrays, metadata["sample"], "sample")
        model = unpack(Model, arrays, metadata["model"], "model")
        return cls(replace(model, frame=0), replace(sample, frame=0), Box(*map(float, metadata["box"])))
