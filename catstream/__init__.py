"""catstream tracks objects in a video stream. It learns each object from a single box, online, on a CPU.

    import catstream

    with catstream.Pipeline("walk.mp4", (120, 80, 64, 48)) as pipeline:
        for track in pipeline:
            print(track.frame, track.state, track.box, track.score)

`catstream.Tracker` tracks in one process, frame by frame, like a `cv2.Tracker`, and `catstream.MultiTracker` tracks
several objects. While a pipeline runs, other processes receive its messages with `catstream.subscribe` and send
commands to it with `catstream.control`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from catstream.errors import require_linux

if TYPE_CHECKING:
    from catstream.base.box import Box
    from catstream.base.settings import Settings
    from catstream.client.attach import control, subscribe
    from catstream.client.control import Control
    from catstream.client.saved_model import SavedModel, merge
    from catstream.client.subscription import Subscription
    from catstream.coreset.tree import CoresetTree, FrequentDirections
    from catstream.errors import CatstreamError
    from catstream.fleet.fleet import Fleet
    from catstream.multi import MultiTracker
    from catstream.offline.annotation import Annotation, annotate
    from catstream.offline.find import Detection, find
    from catstream.pipeline import Pipeline
    from catstream.tracker import Tracker
    from catstream.wire.messages import Track

__all__ = [
    "Annotation",
    "Box",
    "CatstreamError",
    "Control",
    "CoresetTree",
    "Detection",
    "Fleet",
    "FrequentDirections",
    "MultiTracker",
    "Pipeline",
    "SavedModel",
    "Settings",
    "Subscription",
    "Track",
    "Tracker",
    "__version__",
    "annotate",
    "control",
    "find",
    "merge",
    "subscribe",
]

__version__ = "0.1.0"

_HOMES = {
    "Annotation": "offline.annotation",
    "Box": "base.box",
    "CatstreamError": "errors",
    "Control": "client.control",
    "CoresetTree": "coreset.tree",
    "Fleet": "fleet.fleet",
    "FrequentDirections": "coreset.tree",
    "SavedModel": "client.saved_model",
    "MultiTracker": "multi",
    "Pipeline": "pipeline",
    "Settings": "base.settings",
    "Detection": "offline.find",
    "Subscription": "client.subscription",
    "Track": "wire.messages",
    "Tracker": "tracker",
    "annotate": "offline.annotation",
    "control": "client.attach",
    "find": "offline.find",
    "merge": "client.saved_model",
    "subscribe": "client.attach",
}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, so that a process loads only the modules that it needs."""
    if name not in _HOMES:
        raise AttributeError(f"module 'catstream' has no attribute {name!r}")
    if _HOMES[name].startswith(("pipeline", "client", "fleet")):
        require_linux()
    return getattr(import_module(f"catstream.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """The public names too, for `help` and for completion, before their first use."""
    return sorted({*globals(), *__all__})
