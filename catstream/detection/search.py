"""Search: the window of a frame with the highest score, its position, its size and its aspect ratio.

A window is 8 x 8 cells. A search at another size resizes the frame, not the model.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import cycle

import numpy as np

from catstream.base.box import Window
from catstream.detection import belief, extent
from catstream.detection.context import FrameContext
from catstream.detection.similarity import MIN_SIMILARITY, Similarity
from catstream.features.layout import WINDOW
from catstream.features.pyramid import Region
from catstream.features.score_map import ScoreMap, vertex
from catstream.wire.heads import ASPECT, EXTENT, SIZE
from catstream.wire.messages import DetectorState

_MAX_CELLS = 16_384  # limit of a search of the whole frame in one frame, over all sizes: about 14 ms
_FINE_SIDE = WINDOW + 2  # cells searched at each size: the best position may be a cell away from that at another size
_FULL_FACTORS = (1.0, 0.8, 1.25)  # of the object's size, at which a whole frame is searched
_INITIAL_FACTORS = tuple(1.25**k for k in range(-4, 5))  # the same before the first detection of a saved model's object
_DISTANCE_PENALTY = 0.1  # weight of the squared displacement, in windows, in the local search
_REDETECTION_MARGIN = 0.4  # by which the score elsewhere must exceed the local one; with 0.1, similar objects win
_MAX_SIZE_STEPS = 8  # steps of size that are tried, either way, at the first detection of a saved model's object
_MIN_SIGHTINGS = 3  # successive frames that must agree before the object of a saved model counts as detected
_MIN_LEAD = 0.1  # difference of score to the best window elsewhere that each of them needs
_LEAD_OVER_SIMILAR = 0.25  # the same if the similarity of that window is at least half as high
SAME_OVERLAP = 0.3  #: IoU above which two windows in successive frames show the same object

#: A region of a frame that is searched, and the factor of the window's size in it.
_Part = tuple[float, Region]


@dataclass(frozen=True, slots=True)
class Detection:
    """The best window of a search.

    score       of the window
    window      its position in the frame
    around      scores of the windows around it, if a local search detected it
    redetected  whether a search of the whole frame detected it, away from the predicted position
    """

    score: float
    window: Window
    around: ScoreMap | None = None
    redetected: bool = False


def find(context: FrameContext, state: DetectorState) -> Detection:
    """Search near the predicted window; also in the whole frame, if the belief is low.

    The whole frame is searched at 0.8, 1 and 1.25 times the last confident size. If it has more than `_MAX_CELLS` cells
    at the three sizes, each frame is searched in part; every second part is around the window, if the window is tiny.
    """
    settings, first = context.settings, state.first_window
    last_confident = state.confident_window.centred(*state.window.centre)  # its size, at the predicted centre
    if settings.search.mode == "full":
        doubtful = not state.trusted or state.level == "lost"
        window = last_confident if doubtful else state.window
        best = _best_of(context, _whole_frame(context, window, _FULL_FACTORS), window)
        best = fit_extent(context, best, first)
        return replace(best, redetected=not best.window.overlap(state.window))
    # Step 1: search near the predicted window. The belief in the best window determines whether to search elsewhere.
    nearby = fit_extent(context, local_search(context, state.window), first)
    level = belief.level_of(nearby.score, state.trusted, settings.belief)
    interval = belief.policies(settings.search.full_interval)[level].search_interval
    if not interval:
        return nearby
    # Step 2: search the part of the whole frame that is due.
    regions = tuple(region for _, region in _whole_frame(context, last_confident, _FULL_FACTORS))
    batches = _batches(last_confident.w, last_confident.h, regions, context.pyramid.region)
    number = due_part(context.seq, interval, len(batches))
    if number is None:
        return nearby
    elsewhere = _best_of(context, batches[number], last_confident)
    # Step 3: replace the best window nearby if the score elsewhere is clearly higher, and not lower once it is refined.
    if elsewhere.score > max(settings.belief.confident_score, nearby.score + _REDETECTION_MARGIN):
        elsewhere = fit_extent(context, local_search(context, elsewhere.window), first)
        if elsewhere.score > nearby.score:
            return replace(elsewhere, redetected=True)
    return nearby


def seek(context: FrameContext, state: DetectorState, similarity: Similarity) -> tuple[DetectorState, Detection]:
    """Search the whole frame for the object of a saved model, over the sizes that are tried before its first detection.

    The object is detected once the best window is similar to it and leads the rest of the frame, at one position in
    several successive frames: the state then has a first window. While no score is high, each frame is searched at a
    third of the sizes.
    """
    threshold = context.settings.belief.confident_score
    best, stands_out = _search_all_sizes(context, state.window, _INITIAL_FACTORS[context.seq % 3 :: 3], similarity)
    if state.sightings or best.score >= threshold:
        best, stands_out = _search_all_sizes(context, state.window, _INITIAL_FACTORS, similarity)
    sightings = 0
    if best.score >= threshold and stands_out:
        same_position = state.sightings > 0 and best.window.overlap(state.confident_window) > SAME_OVERLAP
        sightings = state.sightings + 1 if same_position else 1
    state = replace(state, sightings=sightings, confident_window=best.window)
    if sightings < _MIN_SIGHTINGS:
        return state, best
    resized = _fit_size_by_similarity(context, best, similarity)
    detection = replace(resized, score=best.score, redetected=True)
    return replace(state, window=detection.window, first_window=detection.window), detection


def _fit_size_by_similarity(context: FrameContext, detection: Detection, similarity: Similarity) -> Detection:
    """Move a detection by at most a cell, to the size with the highest sum of score and similarity.

    The score alone prefers windows that are too small, because they contain less background, and it may be higher than
    that of the object's mean, 1. The subspace of the object contains its own outline and margin.
    """

    def evaluate(step: int) -> tuple[float, Detection]:
        scores = context.scores_around(detection.window.scaled(extent.size(step)), _FINE_SIDE)
        best = Detection(*scores.best())
        return min(best.score, 1.0) + similarity(scores.cells.row(*scores.argmax())), best

    candidates = [evaluate(step) for step in range(-_MAX_SIZE_STEPS, _MAX_SIZE_STEPS + 1)]
    return max(candidates, key=lambda candidate: candidate[0])[1]


def local_search(context: FrameContext, window: Window) -> Detection:
    """Return the best window near another one, of its size.

    A small part of the squared displacement is subtracted from the score: of two equal windows, the nearer one wins.
    """
    side = WINDOW + 2 * round((context.settings.search.area - 1) * WINDOW / 2)
    scores = context.scores_around(window, side)
    distance = (np.arange(side - WINDOW + 1) - (side - WINDOW) // 2) / WINDOW
    return Detection(*scores.best(_DISTANCE_PENALTY * (distance[:, None] ** 2 + distance**2)), around=scores)


def due_part(seq: int, interval: int, count: int) -> int | None:
    """Return the number of the part of a task that is due in a frame; None if no part is.

    Of `count` parts, each is due once in `interval` frames, or once in `count` frames if there are more parts.

    >>> [due_part(seq, 5, 2) for seq in range(7)], [due_part(seq, 1, 3) for seq in range(5)]
    ([0, 1, None, None, None, 0, 1], [0, 1, 2, 0, 1])
    """
    number = seq % max(interval, count)
    return number if number < count else None


def _whole_frame(context: FrameContext, window: Window, factors: Iterable[float]) -> list[_Part]:
    """Return the regions of a whole frame around a window at several factors of its size."""
    return [(factor, context.pyramid.region_around(window.scaled(factor))) for factor in factors]


@lru_cache(maxsize=8)  # a 4K frame has thousands of parts for a tiny window
def _batches(width: float, height: float, regions: tuple[Region, ...], frame: Region) -> list[list[_Part]]:
    """Group the parts of a frame into batches, one for each search, of at most `_MAX_CELLS` cells.

    If the regions around a tiny window are smaller than the frame, every second batch is of the regions.
    """
    around: list[list[_Part]] = []
    everywhere: list[list[_Part]] = []
    for batches, areas in ((around, regions), (everywhere, (frame,) * len(regions))):
        cells_left = 0.0
        for factor, region in zip(_FULL_FACTORS, areas, strict=True):
            sized = Window(0.0, 0.0, width, height).scaled(factor)
            parts = region.split(sized, _MAX_CELLS)
            cells = parts[0].cells(sized)  # as many as in the other parts
            for part in parts:
                if cells > cells_left:
                    batches.append([])
                    cells_left = _MAX_CELLS
                batches[-1].append((factor, part))
                cells_left -= cells
    return everywhere if around == everywhere else [batch for pair in zip(cycle(around), everywhere) for batch in pair]


def _best_of(context: FrameContext, parts: list[_Part], window: Window) -> Detection:
    """Return the best window of several parts of a frame, each searched at the size of a window times a factor."""
    best, _ = _score_parts(context, parts, window)
    return Detection(*best.best())


def _score_parts(context: FrameContext, parts: list[_Part], window: Window) -> tuple[ScoreMap, list[ScoreMap]]:
    """Score several parts, each at the size of a window times its factor.

    Returns the map with the highest score less the cost of its factor of size; and all maps.
    """
    maps = [context.scores_within(region, window.scaled(factor)) for factor, region in parts]
    values = [
        float(one.scores.max()) - extent.cost(math.log(factor)) for one, (factor, _) in zip(maps, parts, strict=True)
    ]
    return maps[values.index(max(values))], maps


def _search_all_sizes(
    context: FrameContext, window: Window, factors: tuple[float, ...], similarity: Similarity
) -> tuple[Detection, bool]:
    """Return the best window of a whole frame at several sizes, and whether it stands out.

    It stands out if it is similar to the object and leads the rest of the frame. In a scene that the model never saw,
    anything may score high: the rival, the best window that does not overlap this one, shows how high. The score of the
    background's mean is 0.
    """
    parts = _whole_frame(context, window, factors)
    scores, maps = _score_parts(context, parts, window)
    best = Detection(*scores.best())
    best_similarity = similarity(scores.cells.row(*scores.argmax()))
    others = [part.non_overlapping(best.window) for part in maps]
    rival_map = max(others, key=lambda part: float(part.scores.max()))
    rival_score = max(float(rival_map.scores.max()), 0.0)
    lead = best.score - rival_score
    if best_similarity < MIN_SIMILARITY or lead < _MIN_LEAD:
        return best, False
    rival_similarity = similarity(rival_map.cells.row(*rival_map.argmax())) if rival_score else 0.0
    return best, lead >= _LEAD_OVER_SIMILAR or rival_similarity < best_similarity / 2


def fit_extent(context: FrameContext, detection: Detection, first: Window | None) -> Detection:
    """Move a detection by at most a cell, to the size and then the aspect ratio with the highest value.

    The value is the score, plus the value of the extent head, less the cost of the change, and less the cost of the
    error that the size head or the aspect head predicts. The prior favours the extent of the `first` window.
    """
    first = first or detection.window
    prior = extent.prior(context.settings.extent)
    growth = math.log(detection.window.area / first.area) / 2

    def value_of_size(step: int) -> tuple[float, Detection]:
        scores = context.scores_around(detection.window.scaled(extent.size(step)), _FINE_SIDE)
        best = Detection(*scores.best())
        fit = _extent_value(context, scores.cells.row(1, 1), SIZE)
        return best.score + fit - extent.cost(step * extent.SIZE_CHANGE, growth, prior), best

    best, _, offset = _climb(value_of_size, context.settings.extent.size_count // 2)
    window = best.window.scaled(extent.size(offset))
    resized = replace(detection, score=best.score, window=window)
    if EXTENT not in context.model.heads:
        return resized
    widening = math.log(window.w / window.h * first.h / first.w)

    def value_of_aspect(step: int) -> tuple[float, Detection]:
        scores = context.scores_around(window.scaled(*extent.stretch(step)), WINDOW)
        fit = _extent_value(context, scores.cells.row(0, 0), ASPECT)
        return float(scores.scores[0, 0]) + fit - extent.cost(step * extent.ASPECT_CHANGE, widening, prior), resized

    _, step, offset = _climb(value_of_aspect, extent.ASPECT_STEPS)
    return replace(resized, window=window.scaled(*extent.stretch(step + offset)))


def _extent_value(context: FrameContext, row: np.ndarray, name: str) -> float:
    """The value of the extent head, less the cost of the error that the head `name` predicts.

    It is 0 if `extent.learned` is off, whether the model has the heads or not: a saved model may have them.
    """
    model = context.model
    if not context.settings.extent.learned:
        return 0.0
    value = float(row @ model.heads[EXTENT]) if EXTENT in model.heads else 0.0
    if name in model.heads and name in model.biases:
        value -= extent.offset_cost(row, model.heads[name], model.biases[name])
    return value


def _climb(evaluate: Callable[[int], tuple[float, Detection]], max_steps: int) -> tuple[Detection, int, float]:
    """Hill climbing from step 0, up or down for as long as the value rises, at most `max_steps` steps either way.

    Returns the detection at the best step, the step, and the offset of the vertex of the parabola through its
    neighbours.
    """
    trials = {step: evaluate(step) for step in range(-min(max_steps, 1), min(max_steps, 1) + 1)}
    best = direction = max(trials, key=lambda step: trials[step][0])
    while direction and abs(best) < max_steps:
        trials[best + direction] = evaluate(best + direction)
        if trials[best + direction][0] <= trials[best][0]:
            break
        best += direction
    neighbours = (best - 1, best, best + 1)
    if not all(step in trials and math.isfinite(trials[step][0]) for step in neighbours):
        return trials[best][1], best, 0.0
    return trials[best][1], best, vertex(np.array([trials[step][0] for step in neighbours]), 1)
