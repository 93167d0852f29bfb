"""An MCAP file of a running pipeline, which Foxglove and the libraries of https://mcap.dev open."""

from __future__ import annotations

import json
import time
from base64 import b64encode
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from catstream.base.files import open_locked, writing
from catstream.client.attach import subscribe
from catstream.errors import SilenceError, VideoError
from catstream.messages.kinds import Health, Model, Preview
from catstream.sinks.destinations import Origin, TrackedFrame

_DATA = {"data": {"type": "string", "contentEncoding": "base64"}}

#: Topic -> name and fields of its schema. Foxglove shows the last one as pictures.
_SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    **{topic: (f"catstream.{topic}", {}) for topic in ("tracks", "models", "health")},
    "previews": ("foxglove.CompressedImage", _DATA),
}


class McapSink:
    """The tracks, and the models, health reports and pictures that the pipeline sends meanwhile, as JSON.

    If the process is killed, `mcap recover` finds the messages but those of the last megabyte.
    """

    def __init__(self, place: str, origin: Origin) -> None:
        from mcap.writer import Writer

        self._place = place
        with ExitStack() as stack:
            file = stack.enter_context(open_locked(Path(place), VideoError, mode="ab"))
            self._writer = Writer(file)
            self._writer.start("catstream")
            self._topics: dict[str, int] = {}
            for topic, (name, fields) in _SCHEMAS.items():
                schema = json.dumps({"type": "object", "properties": fields}).encode()
                number = self._writer.register_schema(name, "jsonschema", schema)
                self._topics[topic] = self._writer.register_channel(topic, "json", number)
            self._others = {
                topic: stack.enter_context(subscribe(origin.address, topic, timeout=0))
                for topic in _SCHEMAS
                if topic != "tracks"
            }
            self._stack = stack.pop_all()

    def write(self, frame: TrackedFrame) -> None:
        """Add the tracks of a frame, and what has arrived meanwhile."""
        for track in frame.tracks:
            self._add("tracks", track.to_dict())
        for topic, messages in self._others.items():
            with suppress(SilenceError):  # none has arrived
                for message in messages:
                    self._add(topic, _fields(message))

    def close(self) -> None:
        """Write the index, and close the file."""
        with writing(self._place, VideoError), self._stack:
            self._writer.finish()

    def _add(self, topic: str, fields: dict[str, Any]) -> None:
        now, data = time.time_ns(), json.dumps(fields, default=np.ndarray.tolist).encode()
        with writing(self._place, VideoError):
            self._writer.add_message(self._topics[topic], now, data, now)


def _fields(message: Model | Health | Preview) -> dict[str, Any]:
    """The fields of a message; those of a picture as Foxglove names them."""
    if not isinstance(message, Preview):
        return asdict(message)
    stamp = dict(zip(("sec", "nsec"), divmod(time.time_ns(), 10**9), strict=True))
    picture = b64encode(message.jpeg).decode()
    return {"timestamp": stamp, "frame_id": str(message.frame), "format": "jpeg", "data": picture}
