"""The objects that a pipeline tracks, as the page shows them. It uses no socket and no clock."""

from __future__ import annotations

from dataclasses import dataclass

from catstream.messages.kinds import Health, Model, State, Track
from catstream.video.annotate import Colours


@dataclass(slots=True)
class ShownObject:
    """One of the objects.

    colour         colour of its box, #rrggbb
    state, score   those of its newest track
    version        version of the model that scored it
    began          number of its first frame, None before its first track
    seq            number of its newest track, 0 before the first
    model_latency  seconds from the track of a frame to the model that was trained on it, None before the first model
    """

    colour: str
    state: State = "absent"
    score: float = 0.0
    version: int = 0
    began: int | None = None
    seq: int = 0
    model_latency: float | None = None


class Objects:
    """The objects by name, in the order in which they began.

    Attributes
    ----------
    shown : the objects
    colours : the colour of each of them
    """

    def __init__(self) -> None:
        self.shown: dict[str, ShownObject] = {}
        self.colours = Colours()
        self._models: dict[str, Model] = {}  # newest models, also of objects without a track yet

    @property
    def models(self) -> dict[str, Model]:
        """The newest model of each object that has one; not that of another object that had the name before."""
        return {
            name: model
            for name, each in self.shown.items()
            if (model := self._models.get(name)) is not None and model.began == each.began
        }

    def add_track(self, track: Track) -> bool:
        """Add a track; return whether another object of this name begins with it."""
        name, before = track.object, self.shown.get(track.object)
        begins = before is not None and before.began not in (None, track.began)
        if before is None or begins:
            self.shown[name] = ShownObject(self.colours.of(name))
        each = self.shown[name]
        each.state, each.score, each.version, each.seq = track.state, track.score, track.model_version, track.seq
        each.began = track.began
        return begins

    def add_model(self, model: Model, latency: float | None) -> None:
        """Add a model that arrived `latency` seconds after the track of its frame, None if that is not known.

        It is ignored if it is of another object that had the name before.
        """
        name = model.object
        each, before = self.shown.get(name), self._models.get(name)
        if each is not None and each.began is not None and model.began < each.began:
            return
        self._models[name] = model
        is_new = before is None or before.version != model.version
        if each is not None and each.began == model.began and latency is not None and is_new:
            each.model_latency = latency

    def add_health(self, health: Health) -> set[str]:
        """Add the objects of the detector's health report that have no track yet; drop those that it does not track.

        Returns
        -------
        the names of the dropped objects
        """
        if len(health.objects) != health.counters.get("objects"):  # it has no track of some objects yet
            return set()
        for name, counters in health.objects.items():
            if name not in self.shown:
                version = int(counters.get("model_version", 0))
                state: State = "absent" if not counters.get("present") else "present" if version else "bootstrapping"
                self.shown[name] = ShownObject(self.colours.of(name), state, counters.get("score", 0.0), version)
        sent = health.counters.get("sent", 0)  # a track after this one may be of an object that began later
        dropped = {name for name, each in self.shown.items() if name not in health.objects and each.seq <= sent}
        for name in dropped:
            del self.shown[name]
            self._models.pop(name, None)
        self.colours.keep(self.shown)
        return dropped
