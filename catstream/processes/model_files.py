"""The saved models of searched objects, in memory and in files."""

from __future__ import annotations

import logging
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path

from catstream.base.files import write_atomically
from catstream.client.saved_model import SavedModel
from catstream.errors import CatstreamError
from catstream.processes.decisions import DesiredObject

_log = logging.getLogger(__name__)


class ModelFiles:
    """Saved models in memory and in a folder, by a digest of their content: a restarted detector needs them again."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._models: dict[str, SavedModel] = {}

    def add(self, saved: SavedModel) -> DesiredObject:
        """Add a saved model in memory; returns a desired object that begins with it in the first message."""
        data = saved.to_bytes()
        name = blake2b(data, digest_size=16).hexdigest()
        self._models[name] = saved
        return DesiredObject(saved.box, 1, name, len(data), saved.model.version)

    def get(self, name: str) -> SavedModel | None:
        """The saved model with a name, None if its file is not readable."""
        if name not in self._models:
            try:
                self._models[name] = SavedModel.load(self._file(name))
            except CatstreamError as error:
                _log.warning("the search for the object of a saved model was stopped: %s", error)
        return self._models.get(name)

    def store(self) -> None:
        """Write the saved models that have no file yet; OSError if this fails."""
        for name, saved in self._models.items():
            if not self._file(name).exists():
                self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                write_atomically(self._file(name), saved.to_bytes(), mode=0o600)

    def keep_only(self, names: set[str]) -> None:
        """Remove all other saved models; if a file cannot be removed, a later call retries."""
        self._models = {name: saved for name, saved in self._models.items() if name in names}
        with suppress(OSError):
            for file in self._folder.glob("*.safetensors"):
                if file.stem not in names:
                    file.unlink()

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.safetensors"
