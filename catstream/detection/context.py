"""`FrameContext`: a frame, with the model and the settings that score its windows."""

from __future__ import annotations

from dataclasses import dataclass

from catstream.base.box import Window
from catstream.base.settings import Settings
from catstream.features.pyramid import Pyramid, Region
from catstream.features.score_map import ScoreMap
from catstream.wire.messages import Model


@dataclass(frozen=True, slots=True, eq=False)
class FrameContext:
    """A frame in which one object is searched for.

    pyramid   the frame
    model     of the object
    settings  of the run
    seq       number of the frame's message, which selects the periodic tasks of a frame
    """

    pyramid: Pyramid
    model: Model
    settings: Settings
    seq: int = 0

    def scores_around(self, window: Window, side: int) -> ScoreMap:
        """Scores of all windows in `side` x `side` cells around a window: see `ScoreMap.around`."""
        return ScoreMap.around(self.pyramid, window, side, self.model)

    def scores_within(self, region: Region, window: Window) -> ScoreMap:
        """Scores of all windows of a size in a region: see `ScoreMap.within`."""
        return ScoreMap.within(self.pyramid, region, window, self.model)

    def scores_of_frame(self, window: Window) -> ScoreMap:
        """Scores of all windows of a size in the frame; if it is large, in the region around the window."""
        return self.scores_within(self.pyramid.region_around(window), window)
