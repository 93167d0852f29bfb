"""The coreset trees of each object as a file, for subscribers that save it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic

from catstream.compression.compressor import Compressor
from catstream.errors import ServiceError
from catstream.messages.kinds import SavedModel
from catstream.run.learned import Learned
from catstream.services.timing import SAVED_MODEL_SECONDS
from catstream.settings import Settings
from catstream.wire.channels import SAVED_MODELS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher


class SavedModels(Publisher[SavedModel]):
    """Sends the trees of each object after each new sample, at most once a second; nothing without subscribers."""

    def __init__(self, endpoint: Endpoint, settings: Settings) -> None:
        super().__init__(SAVED_MODELS, endpoint)
        self._settings = settings
        self._sent: dict[str, tuple[int, float]] = {}  # version and time of the last file of each object

    def turn(self, compressors: Mapping[str, Compressor], after_each: Callable[[], object]) -> None:
        """Send the files that are due; call it in every turn, as subscribers may join.

        Parameters
        ----------
        after_each : is called after each file
        """
        self.serve_late_joiners()
        if not self.has_subscribers:
            if self._sent:  # the next subscriber gets new files only
                self._sent.clear()
                self.keep_only(())
            return
        for name, compressor in compressors.items():
            version, moment = self._sent.get(name, (0, 0.0))
            if compressor.version > version and (not version or monotonic() - moment >= SAVED_MODEL_SECONDS):
                self._send(name, compressor)
                after_each()

    def _send(self, name: str, compressor: Compressor) -> None:
        try:
            learned = Learned.of(compressor, self._settings)
        except ServiceError:  # the object of a saved model has not been found yet
            return
        self.send(SavedModel(compressor.version, learned.to_bytes(), name))
        self._sent[name] = compressor.version, monotonic()
