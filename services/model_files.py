"""The files of the saved models that objects begin with: a restarted detector begins the objects again."""

from __future__ import annotations

import logging
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path

from catstream.errors import CatstreamError
from catstream.messages import storage
from catstream.run.learned import Learned
from catstream.services.core_state import Saved

_log = logging.getLogger(__name__)


class ModelFiles:
    """Saved models by name, which is a digest of the content, in memory and in a folder.

    Parameters
    ----------
    folder : folder of the files; None if they are kept in memory only
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._models: dict[str, Learned] = {}

    def add(self, learned: Learned) -> Saved:
        """Keep a saved model in memory, under the name that is returned."""
        data = learned.to_bytes()
        name = blake2b(data, digest_size=16).hexdigest()
        self._models[name] = learned
        return Saved(name, learned.box, learned.model.version, len(data))

    def get(self, name: str) -> Learned | None:
        """The saved model of a name, None if its file cannot be read."""
        if name not in self._models and self._folder is not None:
            try:
                self._models[name] = Learned.load(self._file(name))
            except CatstreamError as error:
                _log.warning("the object of a saved model is not searched for any more: %s", error)
        return self._models.get(name)

    def store(self) -> None:
        """Write the saved models in memory that have no file yet.

        Raises
        ------
        OSError
            If a file cannot be written.
        """
        for name, learned in self._models.items():
            if self._folder is not None and not self._file(name).exists():
                self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                storage.write_atomically(self._file(name), learned.to_bytes(), mode=0o600)

    def keep_only(self, names: set[str]) -> None:
        """Remove all saved models but those of these names; a file that cannot be removed is left to a later call."""
        self._models = {name: learned for name, learned in self._models.items() if name in names}
        with suppress(OSError):
            for file in self._folder.glob("*.safetensors") if self._folder is not None else ():
                if file.stem not in names:
                    file.unlink()

    def _file(self, name: str) -> Path:
        return (self._folder or Path()) / f"{name}.safetensors"
