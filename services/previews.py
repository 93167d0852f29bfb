"""Small pictures of the newest frames, for subscribers."""

from __future__ import annotations

from time import monotonic

import numpy as np

from catstream.box import Box
from catstream.messages.kinds import Preview
from catstream.services.timing import PREVIEW_SECONDS
from catstream.video.frames import jpeg
from catstream.wire.channels import PREVIEWS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher

_SIDE = 640  # longest side of a picture, in pixels


class Previews(Publisher[Preview]):
    """Sends the newest frame as a small picture, at most ten a second; none is made if there are no subscribers."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(PREVIEWS, endpoint)
        self._waiting: tuple[int, np.ndarray, dict[str, Box]] | None = None
        self._shown = 0.0

    def show(self, frame: int, image: np.ndarray, boxes: dict[str, Box]) -> None:
        """Send a frame, unless a newer one arrives before it is due.

        Parameters
        ----------
        frame : number of the frame
        image : uint8 (h, w, 3) BGR, not to be changed afterwards
        boxes : the objects in the frame, by name
        """
        self._waiting = frame, image, boxes
        self.turn()

    def turn(self) -> None:
        """Send a preview if one is due; call it in every turn, even if no frame arrives, as subscribers may join."""
        self.serve_late_joiners()
        if self._waiting is None or not self.has_subscribers or monotonic() - self._shown < PREVIEW_SECONDS:
            return
        (frame, image, boxes), self._waiting, self._shown = self._waiting, None, monotonic()
        height, width = image.shape[:2]
        self.send(Preview(frame, width, height, boxes, jpeg(image, _SIDE)))
