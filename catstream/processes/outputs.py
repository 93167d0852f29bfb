"""What a detector sends, and the files of the saved models that its objects begin with."""

from __future__ import annotations

import logging
from collections import deque
from contextlib import AbstractContextManager, ExitStack, suppress
from hashlib import blake2b
from pathlib import Path
from time import monotonic

from catstream.base.box import Box
from catstream.base.files import write_atomically
from catstream.errors import CatstreamError
from catstream.jobs.saved_model import SavedModel
from catstream.messages.kinds import End, Features, Preview, Tracks
from catstream.processes.decisions import DesiredObject
from catstream.processes.process import Process
from catstream.video.frames import Frame, jpeg
from catstream.video.source import is_live
from catstream.wire.acknowledged import Sender
from catstream.wire.channels import FEATURES, PREVIEWS, TRACKS, TRAINING
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher
from catstream.wire.results import ResultsSender

_PREVIEW_SECONDS = 0.1  # shortest time between two pictures for subscribers
_SIDE = 640  # longest side of a picture, in pixels
_KEPT_SECONDS = 5.0  # for which the frame of a picture is kept, as somebody may draw a box in it
_KEPT_BYTES = 256 << 20  # of these frames at most

_log = logging.getLogger(__name__)


class Outputs(AbstractContextManager["Outputs"]):
    """The sockets that a detector sends on, with `results` only if the run has an owner; a context manager."""

    def __init__(self, process: Process) -> None:
        window, endpoint = process.settings.run.unstored_frames, process.endpoint
        with ExitStack() as stack:
            self.features = stack.enter_context(Sender(FEATURES, endpoint, window))
            self.results = stack.enter_context(ResultsSender(endpoint, window + 1)) if process.job.run else None
            self._tracks = stack.enter_context(Publisher(TRACKS, endpoint))
            self._training = stack.enter_context(Publisher(TRAINING, endpoint))
            self.previews = stack.enter_context(Previews(endpoint, keeps=is_live(process.job.source)))
            self._stack = stack.pop_all()

    def serve_late_joiners(self) -> None:
        """Send the end or the newest preview to new subscribers."""
        self._tracks.serve_late_joiners()
        self._training.serve_late_joiners()
        self.previews.turn()

    def publish(self, tracks: Tracks | End, features: Features | End) -> None:
        """Send the tracks of a frame, one message an object, and its features to all subscribers; or the end."""
        for each in tracks.tracks.values() if isinstance(tracks, Tracks) else (tracks,):
            self._tracks.send(each)
        self._training.send(features)

    def __exit__(self, *_: object) -> None:
        self._stack.close()


class Previews(Publisher[Preview]):
    """Sends the newest frame as a small picture, at most ten a second; none is made if there are no subscribers.

    If it `keeps` them, the frames of the last pictures are kept, too, while there are subscribers.
    """

    def __init__(self, endpoint: Endpoint, *, keeps: bool = False) -> None:
        super().__init__(PREVIEWS, endpoint)
        self._waiting: tuple[int, Frame, dict[str, Box]] | None = None
        self._shown = 0.0
        self._keeps, self._kept = keeps, deque[Frame]()

    def show(self, number: int, frame: Frame, boxes: dict[str, Box]) -> None:
        """Send a frame, whose image stays unchanged, unless a newer one arrives before it is due."""
        self._waiting = number, frame, boxes
        self.turn()

    def since(self, time: float) -> list[Frame]:
        """The kept frames, from that of the picture at a time on; none if that is not kept any more."""
        frames = [frame for frame in self._kept if frame.time >= time]
        return frames if frames and frames[0].time == time else []

    def turn(self) -> None:
        """Send a preview if one is due; call it in every turn, even if no frame arrives, as subscribers may join."""
        self.serve_late_joiners()
        if not self.has_subscribers:
            self._kept.clear()
        if self._waiting is None or not self.has_subscribers or monotonic() - self._shown < _PREVIEW_SECONDS:
            return
        (number, frame, boxes), self._waiting, self._shown = self._waiting, None, monotonic()
        height, width = frame.image.shape[:2]
        self.send(Preview(number, frame.time, width, height, boxes, jpeg(frame.image, _SIDE)))
        if self._keeps:
            most = max(1, _KEPT_BYTES // frame.image.nbytes)
            self._kept.append(frame)
            while self._kept[0].time < frame.time - _KEPT_SECONDS or len(self._kept) > most:
                self._kept.popleft()


class ModelFiles:
    """The saved models that objects begin with: a restarted detector begins the objects again.

    Each has a name, which is a digest of its content. They are in memory, and in a folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._models: dict[str, SavedModel] = {}

    def add(self, learned: SavedModel) -> DesiredObject:
        """Keep a saved model in memory; returns the object that it begins in the first message, with its name."""
        data = learned.to_bytes()
        name = blake2b(data, digest_size=16).hexdigest()
        self._models[name] = learned
        return DesiredObject(learned.box, 1, name, len(data), learned.model.version)

    def get(self, name: str) -> SavedModel | None:
        """The saved model of a name, None if its file cannot be read."""
        if name not in self._models:
            try:
                self._models[name] = SavedModel.load(self._file(name))
            except CatstreamError as error:
                _log.warning("the object of a saved model is not searched for any more: %s", error)
        return self._models.get(name)

    def store(self) -> None:
        """Write the saved models in memory that have no file yet; OSError if that fails."""
        for name, learned in self._models.items():
            if not self._file(name).exists():
                self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
                write_atomically(self._file(name), learned.to_bytes(), mode=0o600)

    def keep_only(self, names: set[str]) -> None:
        """Remove all saved models but those of these names; a file that cannot be removed is left to a later call."""
        self._models = {name: learned for name, learned in self._models.items() if name in names}
        with suppress(OSError):
            for file in self._folder.glob("*.safetensors"):
                if file.stem not in names:
                    file.unlink()

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.safetensors"
