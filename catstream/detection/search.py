"""Search: the window of a frame that scores highest, its place, its size and its aspect ratio.

A window is 8 x 8 cells. A search at another size resizes the frame, not the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from catstream.base.box import Window
from catstream.base.settings import BeliefSettings, ExtentSettings, SearchSettings, Settings
from catstream.detection import belief, extent
from catstream.detection.similarity import Similarity
from catstream.features.layout import EDGE, WINDOW
from catstream.features.pyramid import Pyramid, Region
from catstream.features.score_map import ScoreMap, non_maximum_suppression, vertex
from catstream.features.vectors import VectorMap
from catstream.messages.heads import ASPECT, EXTENT, SIZE
from catstream.messages.kinds import DetectorState, Model

_MOST_CELLS = 16_384  # limit of a search of the whole frame in one frame, over all sizes: about 14 ms
_FINE_SIDE = WINDOW + 2  # cells searched at each size: the best place may be a cell away from that at another size
_MOST_DESCRIBED = 10  # windows of a search of the whole frame, the best by HOG and colours, that a descriptor sees
_WHOLE_FACTORS = (1.0, 0.8, 1.25)  # of the object's size, at which a whole frame is searched
_SOUGHT_FACTORS = tuple(1.25**k for k in range(-4, 5))  # of the size of an object that has not been found yet
_DISTANCE_PENALTY = 0.1  # weight of the squared displacement, in windows, in the local search
_LIKELY_STEPS = 8  # larger or smaller than the size at which an object was first found, that are tried
_SIGHTINGS = 3  # successive frames that must agree before the object of a saved model is found
_SIGHTING_LEAD = 0.1  # difference of score to the best window elsewhere that it needs
_LEAD_OVER_ALIKE = 0.25  # difference of score to another window whose similarity to the object is at least half as high
SAME_OVERLAP = 0.3  #: above which two windows in successive frames show the same object

#: A region of a frame that is searched, and the factor of the window's size in it.
_Part = tuple[float, Region]


@dataclass(frozen=True, slots=True)
class Detection:
    """The best window of a search.

    score       of the window
    window      where it lies in the frame
    around      scores of the windows around it, if a local search found it
    redetected  whether a search of the whole frame found it, away from where the object was expected
    """

    score: float
    window: Window
    around: ScoreMap | None = None
    redetected: bool = False


def find(frame: Pyramid, state: DetectorState, seq: int, model: Model, settings: Settings) -> Detection:
    """The best window near the expected one; of the whole frame, if belief is low and another leads clearly.

    `seq` of the frame says whether a search of the whole frame is due.
    """
    confident = state.confident_window.centred(*state.window.centre)  # as large as in the last confident detection
    if settings.search.mode == "full":
        doubtful = not state.trusted or state.level == "lost"
        best = whole(frame, confident if doubtful else state.window, model)
        best = fitted(frame, best, state.first_window, model, settings.extent)
        return replace(best, redetected=not best.window.overlap(state.window))
    near = _near(frame, state.window, state, model, settings)
    level = belief.level_of(near.score, state.trusted, settings.belief)
    interval = belief.policies(settings.search.whole_interval)[level].search_interval
    other = _elsewhere(frame, confident, seq, interval, model) if interval else None
    if other is not None and belief.is_redetection(other.score, near.score, settings.belief):
        other = _near(frame, other.window, state, model, settings)
        if other.score > near.score:
            return replace(other, redetected=True)
    return near


def seek(
    frame: Pyramid, state: DetectorState, seq: int, model: Model, similarity: Similarity, settings: Settings
) -> tuple[DetectorState, Detection]:
    """The best window of the whole frame, over the range of sizes that are searched before the first detection.

    The object counts as found once this window has looked like the object and has led the rest of the frame, in one
    place in several successive frames: the state then has a first window. While no score is high, each frame is
    searched at a third of the sizes.
    """
    limits = settings.belief
    best, stands_out = _sighting(frame, state.window, _SOUGHT_FACTORS[seq % 3 :: 3], model, similarity, limits)
    if state.sightings or best.score >= limits.confident_score:
        best, stands_out = _sighting(frame, state.window, _SOUGHT_FACTORS, model, similarity, limits)
    seen = best.score >= limits.confident_score and stands_out
    again = state.sightings > 0 and best.window.overlap(state.confident_window) > SAME_OVERLAP
    state = replace(
        state,
        sightings=0 if not seen else state.sightings + 1 if again else 1,
        confident_window=best.window,
    )
    if state.sightings < _SIGHTINGS:
        return state, best
    found = replace(_at_likely_size(frame, best, model, similarity), score=best.score, redetected=True)
    return replace(state, window=found.window, first_window=found.window), found


def _at_likely_size(frame: Pyramid, found: Detection, model: Model, similarity: Similarity) -> Detection:
    """A detection moved by at most a cell, at the size with the highest sum of score and similarity.

    The score alone prefers windows that are too small, because they contain less background, and it may be higher than
    that of the object's mean, 1. The subspace of the object contains its own outline and margin.
    """

    vectors = _vectors(frame, found)

    def tried(step: int) -> tuple[float, Detection]:
        scores = ScoreMap.around(frame, found.window.scaled(extent.size(step)), _FINE_SIDE, model, vectors)
        best = Detection(*scores.best())
        return min(best.score, 1.0) + similarity(scores.cells.row(*scores.highest())), best

    return max((tried(step) for step in range(-_LIKELY_STEPS, _LIKELY_STEPS + 1)), key=lambda each: each[0])[1]


def local(frame: Pyramid, window: Window, model: Model, settings: SearchSettings) -> Detection:
    """The best window near another, of its size.

    A small part of the squared displacement is subtracted from the score: of two equal windows, the nearer wins.
    """
    side = WINDOW + 2 * round((settings.area - 1) * WINDOW / 2)
    scores = ScoreMap.around(frame, window, side, model)
    away = (np.arange(side - WINDOW + 1) - (side - WINDOW) // 2) / WINDOW
    return Detection(*scores.best(_DISTANCE_PENALTY * (away[:, None] ** 2 + away**2)), around=scores)


def whole(frame: Pyramid, window: Window, model: Model) -> Detection:
    """The best window of a whole frame at three sizes: that of a window, 0.8 and 1.25 times as large."""
    parts = [(factor, frame.region_around(window.scaled(factor))) for factor in _WHOLE_FACTORS]
    return _best_of(frame, parts, window, model)


def due(seq: int, interval: int, count: int) -> int | None:
    """Number of the part of a task that is done with a frame; None if no part is.

    Of `count` parts, each is done once in `interval` frames, or once in `count` frames if there are more parts.

    >>> [due(seq, 5, 2) for seq in range(7)], [due(seq, 1, 3) for seq in range(5)]
    ([0, 1, None, None, None, 0, 1], [0, 1, 2, 0, 1])
    """
    number = seq % max(interval, count)
    return number if number < count else None


def _elsewhere(frame: Pyramid, window: Window, seq: int, interval: int, model: Model) -> Detection | None:
    """The best window of the parts of a frame that are due, at 0.8, 1 or 1.25 times its size; None if none is due.

    At most `_MOST_CELLS` cells are searched in a frame. If the frame has more at the three sizes, its parts take turns;
    every other turn is one around the window, if the window is tiny.
    """
    sizes = [window.scaled(factor) for factor in _WHOLE_FACTORS]
    around = _turns(window.w, window.h, tuple(map(frame.region_around, sizes)))
    everywhere = _turns(window.w, window.h, (frame.region,) * len(sizes))
    if around == everywhere:
        turn = due(seq, interval, len(around))
        return None if turn is None else _best_of(frame, around[turn], window, model)
    turn = due(seq, interval, 2 * len(everywhere))
    if turn is None:
        return None
    turns = everywhere if turn % 2 else around
    return _best_of(frame, turns[turn // 2 % len(turns)], window, model)


@lru_cache(maxsize=8)  # a 4K frame has thousands of parts for a tiny window
def _turns(width: float, height: float, regions: tuple[Region, ...]) -> list[list[_Part]]:
    """The parts of the region of each size that are searched, in groups of at most `_MOST_CELLS` cells."""
    turns: list[list[_Part]] = []
    left = 0.0
    for factor, region in zip(_WHOLE_FACTORS, regions, strict=True):
        sized = Window(0.0, 0.0, width, height).scaled(factor)
        parts = region.split(sized, _MOST_CELLS)
        cells = parts[0].cells(sized)  # as many as in each other part
        for part in parts:
            if not turns or cells > left:
                turns.append([])
                left = _MOST_CELLS
            turns[-1].append((factor, part))
            left -= cells
    return turns


def _best_of(frame: Pyramid, parts: list[_Part], window: Window, model: Model) -> Detection:
    """The best window of several parts of a frame, each searched at the size of a window times a factor."""
    return Detection(*_best_map(_searched(frame, parts, window, model)).best())


def _searched(frame: Pyramid, parts: Iterable[_Part], window: Window, model: Model) -> list[tuple[float, ScoreMap]]:
    """The factor and the scores of several parts of a frame, each searched at the size of a window times its factor.

    With a descriptor, the scores around the windows that are the best of all by HOG and colours.
    """
    maps = [(factor, ScoreMap.within(frame, region, window.scaled(factor), model)) for factor, region in parts]
    if frame.descriptor is None:
        return maps
    windows = [
        (float(scores.scores[place]), factor, scores.window(*place))
        for factor, scores in maps
        for place in non_maximum_suppression(scores.scores, _MOST_DESCRIBED, WINDOW // 2)
    ]
    best = sorted(windows, key=lambda each: -each[0])[:_MOST_DESCRIBED]
    return [(factor, ScoreMap.around(frame, each, _FINE_SIDE, model)) for _, factor, each in best]


def _best_map(maps: Sequence[tuple[float, ScoreMap]]) -> ScoreMap:
    """The map with the highest score less the cost of its factor of size."""
    return max(maps, key=lambda each: float(each[1].scores.max()) - extent.cost(math.log(each[0])))[1]


def _sighting(
    frame: Pyramid,
    window: Window,
    factors: tuple[float, ...],
    model: Model,
    similarity: Similarity,
    limits: BeliefSettings,
) -> tuple[Detection, bool]:
    """The best window of a whole frame, at the size of a window times each of several factors; and whether it looks
    like the object, and leads the rest of the frame.

    In a scene that the model never saw, anything may score high: the rival, the best window that does not touch this
    one, shows how high. The mean of the background that was learned scores 0.
    """
    parts = [(factor, frame.region_around(window.scaled(factor))) for factor in factors]
    maps = _searched(frame, parts, window, model)
    scores = _best_map(maps)
    best, alike = Detection(*scores.best()), similarity(scores.cells.row(*scores.highest()))
    apart = max((each.apart(best.window) for _, each in maps), key=lambda each: float(each.scores.max()))
    rival = max(float(apart.scores.max()), 0.0)
    lead = best.score - rival
    if alike < limits.sighting_similarity or lead < _SIGHTING_LEAD:
        return best, False
    alike_rival = similarity(apart.cells.row(*apart.highest())) if rival else 0.0
    return best, lead >= _LEAD_OVER_ALIKE or alike_rival < alike / 2


def _near(frame: Pyramid, window: Window, state: DetectorState, model: Model, settings: Settings) -> Detection:
    """The best window near another, at its best size and aspect ratio."""
    best = local(frame, window, model, settings.search)
    return fitted(frame, best, state.first_window, model, settings.extent)


def fitted(frame: Pyramid, found: Detection, first: Window | None, model: Model, settings: ExtentSettings) -> Detection:
    """A detection moved by at most a cell, at the size and then the aspect ratio with the highest value.

    The value is the score, plus `weight` times the value of the extent head, less the cost of the change, and less the
    cost of the error that the size head or the aspect head predicts. Size and aspect ratio of the `first` window are
    likelier than others.
    """
    first = first or found.window
    resized = _at_best_size(frame, found, first, model, settings)
    return resized if EXTENT not in model.heads else _at_best_aspect(frame, resized, first, model, settings)


def _at_best_size(frame: Pyramid, found: Detection, first: Window, model: Model, settings: ExtentSettings) -> Detection:
    grown = math.log(found.window.area / first.area) / 2
    vectors = _vectors(frame, found)

    def tried(step: int) -> tuple[float, Detection]:
        scores = ScoreMap.around(frame, found.window.scaled(extent.size(step)), _FINE_SIDE, model, vectors)
        best = Detection(*scores.best())
        fit = _fit(scores.cells.row(1, 1), model, SIZE, settings)
        return best.score + fit - extent.cost(step * extent.SIZE_CHANGE, grown, settings.prior), best

    best, _, beside = _climb(tried, settings.size_count // 2)
    return replace(found, score=best.score, window=best.window.scaled(extent.size(beside)))


def _at_best_aspect(
    frame: Pyramid, found: Detection, first: Window, model: Model, settings: ExtentSettings
) -> Detection:
    widened = math.log(found.window.w / found.window.h * first.h / first.w)
    vectors = _vectors(frame, found)

    def tried(step: int) -> tuple[float, Detection]:
        scores = ScoreMap.around(frame, found.window.scaled(*extent.stretch(step)), WINDOW, model, vectors)
        fit = _fit(scores.cells.row(0, 0), model, ASPECT, settings)
        cost = extent.cost(step * extent.ASPECT_CHANGE, widened, settings.prior)
        return float(scores.scores[0, 0]) + fit - cost, found

    _, step, beside = _climb(tried, settings.aspect_count // 2)
    return replace(found, window=found.window.scaled(*extent.stretch(step + beside)))


def _vectors(frame: Pyramid, found: Detection) -> VectorMap | None:
    """The vectors around a detection, from which those of other sizes are sampled; None without a descriptor."""
    if found.around is not None:
        return found.around.vectors
    if frame.descriptor is None:
        return None
    return VectorMap.of(frame.descriptor, frame.around(found.window, WINDOW, EDGE), found.window)


def _fit(row: np.ndarray, model: Model, name: str, settings: ExtentSettings) -> float:
    """The value of the extent head, less the cost of the error that the head `name` predicts; 0 if `weight` is 0."""
    if not settings.weight:  # a saved model may have the heads
        return 0.0
    fit = settings.weight * float(row @ model.heads[EXTENT]) if EXTENT in model.heads else 0.0
    if name in model.heads and name in model.biases:
        fit -= extent.offset_cost(row, model.heads[name], model.biases[name])
    return fit


def _climb(tried: Callable[[int], tuple[float, Detection]], most: int) -> tuple[Detection, int, float]:
    """Hill climbing: from step 0 up or down for as long as the value rises, at most `most` steps either way.

    Returns the detection at the best step, the step, and the offset of the vertex of the parabola through its
    neighbours.
    """
    trials = {step: tried(step) for step in range(-min(most, 1), min(most, 1) + 1)}
    best = way = max(trials, key=lambda step: trials[step][0])
    while way and abs(best) < most:
        trials[best + way] = tried(best + way)
        if trials[best + way][0] <= trials[best][0]:
            break
        best += way
    neighbours = (best - 1, best, best + 1)
    if not all(step in trials and math.isfinite(trials[step][0]) for step in neighbours):
        return trials[best][1], best, 0.0
    return trials[best][1], best, vertex(np.array([trials[step][0] for step in neighbours]), 1)
