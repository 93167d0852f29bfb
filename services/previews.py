"""Pictures of what the detector sees, for those who look."""

from __future__ import annotations

from time import monotonic

import numpy as np

from catstream.box import Box
from catstream.messages import Preview
from catstream.video.preview import jpeg
from catstream.wire.channels import PREVIEWS
from catstream.wire.endpoint import Endpoint
from catstream.wire.newest import Publisher

__all__ = ["Previews"]

_PERIOD = 0.1  # seconds between two pictures, at least


class Previews(Publisher[Preview]):
    """Sends the newest frame as a small picture, at most ten a second; none is made while nobody listens."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(PREVIEWS, endpoint)
        self._waiting: tuple[int, np.ndarray, Box | None] | None = None
        self._shown = 0.0

    def show(self, frame: int, image: np.ndarray, box: Box | None) -> None:
        """Have a frame sent, unless a newer one comes before it is due.

        Parameters
        ----------
        frame : its number
        image : uint8 (h, w, 3) BGR, not to be changed afterwards
        box : where the object is in it, or None
        """
        self._waiting = frame, image, box
        self.turn()

    def turn(self) -> None:
        """Send what is due; call it now and then, also while no frame comes: somebody may begin to look."""
        self.serve_late_joiners()
        if self._waiting is None or not self.has_subscribers or monotonic() - self._shown < _PERIOD:
            return
        (frame, image, box), self._waiting, self._shown = self._waiting, None, monotonic()
        height, width = image.shape[:2]
        self.send(Preview(frame, width, height, box, jpeg(image)))
