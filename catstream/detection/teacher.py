"""The teacher: training rows of the windows in and around the object's, and the label of each.

A row of the object has label 1, one of the background 0. Between them are near misses, windows beside the object, and
windows of the object of a wrong size or aspect ratio. Both get a Gaussian of their offset, so that scores fall smoothly
around the right window. Windows of wrong extents have a second label, the error of their size or aspect ratio.
The initial model is learned from the rows of the first frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from catstream.base.box import Box, Window
from catstream.base.settings import Settings, TeachingSettings
from catstream.detection import extent
from catstream.detection.search import due
from catstream.detection.similarity import Similarity
from catstream.errors import BoxError
from catstream.features.cells import window_rows
from catstream.features.descriptor import Descriptor
from catstream.features.layout import CELL, COLOURS, EDGE, MARGIN, WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap, non_maximum_suppression
from catstream.features.vectors import VectorMap
from catstream.messages.heads import APPEARANCE, BETWEEN_RIDGE, EXTENT
from catstream.messages.kinds import Model, TrainingRows
from catstream.numerics import ridge

#: Training rows by group, as in `Features`; a group without rows is left out.
Training = dict[str, TrainingRows]

_NEAR = 2  # cells around the object whose windows are near misses, not background
_NEAREST = 0.9  # cells: a nearer window shows the object as well as its own does
_NEAR_SIGMA = 0.9  # cells: standard deviation of the Gaussian label of a near miss
_EXTENT_SIGMA = 1.0  # steps of size or aspect ratio: the same of a window of a wrong extent
_EXTENT_INTERVAL = 2  # frames from one set of rows of windows of wrong extents to the next
_OBJECT_WEIGHT = 8.0  # of a frame's rows of the object together; any other row has weight 1
_BACKGROUND = 12  # windows of the background around the object, of each frame
_SIDE = 20  # cells around the object, at least, from which background is taken
_DESCRIBED = _SIDE + 2 * EDGE  # cells of which a descriptor sees a copy of the object in the middle: as of the object
_MINING_INTERVAL = 8  # frames between two searches for hard negatives; a large frame is searched in parts
_MOST_CELLS = 4096  # limit of a search for hard negatives in one frame: about 4 ms
_HARD_OVERLAP = 0.2  # of a hard negative with the object's window, at most

_PATCH = (WINDOW + 2 * MARGIN) * CELL  # side of a copy with its margin, in pixels
_SCALE, _SHIFT, _TURN = 0.03, 0.02, 0.05  # standard deviations of affine copies: a factor, a share of the box, radians
_NEAREST_OTHER, _FARTHEST_OTHER = 0.3, 1.0  # distance of another background, in windows
_SOLID, _GONE = 0.8, 1.15  # radii between which the object's ellipse fades; 1 touches the sides of its box


def first_training(
    frame: Pyramid, window: Window, rng: np.random.Generator, settings: Settings
) -> tuple[Model, Training]:
    """The initial model and the rows of the first frame, which fill a leaf of each tree.

    If SCM follows the object first, group "appearance" has only the rows of an ordinary frame. BoxError if object and
    background look the same.
    """
    teaching, count = settings.teaching, settings.coreset.size
    around = ScoreMap.around(frame, window, _SIDE, None)
    if teaching.bootstrap == "scm":
        rows = _appearance(frame, window, around, None, rng, teaching)
    else:
        context, moved = settings.search.context, teaching.other_backgrounds
        copies = affine_copies(frame, window, count, rng, around.vectors, context=context, moved=moved)
        rows = _rows(copies, 1, _OBJECT_WEIGHT, teaching)
        rows += _surroundings(around, window, count, 0, rng, teaching)
    training = _first_extents(frame, window, rng, settings)
    rows += hard_negatives(frame, window, initial_model(rows), teaching)
    return initial_model(rows), {APPEARANCE: rows, **training}


def training_of(
    frame: Pyramid, window: Window, around: ScoreMap | None, seq: int, model: Model, settings: Settings
) -> Training:
    """The rows of a frame in which the object was detected, cut around its window.

    Windows of wrong extents are not cut in each frame, and hard negatives in a part of it, as `seq` says.
    """
    training = training_at(frame, window, seq, model, settings, around, extents=seq % _EXTENT_INTERVAL == 0)
    if (mined := _mined(frame, window, seq, model, settings.teaching)) is not None:
        training[APPEARANCE] += mined
    return training


def training_at(
    frame: Pyramid,
    window: Window,
    seq: int,
    model: Model,
    settings: Settings,
    around: ScoreMap | None = None,
    *,
    extents: bool = True,
) -> Training:
    """The rows of an object that is known to be at a window, and of group "extent" if `extents`.

    Near misses and background are taken from the windows around it that a search scored, if they reach far enough.
    """
    rng = np.random.default_rng((settings.run.seed, seq))  # of this frame alone: no frame depends on those before
    if around is None or min(around.cells.shape) < _SIDE:
        around = ScoreMap.around(frame, window, _SIDE, model)
    rows = _appearance(frame, window, around, model, rng, settings.teaching)
    return {APPEARANCE: rows, **(_extents(frame, window, around.vectors, rows, settings) if extents else {})}


def training_beside(
    frame: Pyramid, window: Window, model: Model, similarity: Similarity, settings: Settings
) -> Training:
    """The rows of a frame in which the object of a saved model has not been found yet: background of a new scene.

    Windows with a high score are taken, but neither the best one, which may be the object, nor others that look like
    the object.
    """
    scores = ScoreMap.whole(frame, window, model)
    most, least = settings.teaching.hard_negatives, settings.belief.weak_score
    rows = _strongest(frame, scores, window, model, most, least)
    strange = rows[[similarity(row) < settings.belief.sighting_similarity for row in rows]]
    return {APPEARANCE: _rows(strange, 0, 1, settings.teaching)} if len(strange) else {}


def hard_negatives(frame: Pyramid, window: Window, model: Model, teaching: TeachingSettings) -> TrainingRows:
    """The windows of the whole frame that score highest, without those that overlap the object's."""
    scores = ScoreMap.whole(frame, window, model)
    return _rows(_strongest(frame, scores, window, model, teaching.hard_negatives), 0, 1, teaching)


def _mined(frame: Pyramid, window: Window, seq: int, model: Model, teaching: TeachingSettings) -> TrainingRows | None:
    """The hard negatives of the part of the frame that is due, None if no part is.

    Each part has its share of the rows, so that their number over many frames does not depend on that of the parts.
    """
    parts = frame.region_around(window).split(window, _MOST_CELLS)
    number = due(seq, _MINING_INTERVAL, len(parts))
    if number is None:
        return None
    # Rows of a round: hard_negatives / _MINING_INTERVAL for each of its frames. Each part has an equal share of them.
    rows = teaching.hard_negatives * max(len(parts), _MINING_INTERVAL)
    end, begin = (each * rows // (len(parts) * _MINING_INTERVAL) for each in (number + 1, number))
    if begin == end:
        return None
    scores = ScoreMap.within(frame, parts[number], window, model, described=True)
    return _rows(_strongest(frame, scores, window, model, end - begin), 0, 1, teaching)


def _strongest(
    frame: Pyramid, scores: ScoreMap, window: Window, model: Model, most: int, least: float = -math.inf
) -> np.ndarray:
    """The rows, float32 (k, d), of the windows with the highest scores above `least` that hardly overlap another one.

    Where the scores are those of HOG and colours, a descriptor computes only what the rows need.
    """
    places = non_maximum_suppression(scores.scores, most + 1, WINDOW // 2, least)
    places = [place for place in places if scores.window(*place).overlap(window) < _HARD_OVERLAP][:most]
    described = [scores.complete(frame, place, model) for place in places]
    rows = [each.cells.row(row, column) for each, row, column in described]
    return np.array(rows, np.float32).reshape(-1, len(model.weights))


def initial_model(rows: TrainingRows) -> Model:
    """A model of version 0, by least squares of the object's mean against the background's mean and covariance.

    BoxError if the two look the same.
    """
    background = rows.rows[rows.labels == 0]
    mean, background_mean = rows.rows[rows.labels == 1].mean(axis=0), background.mean(axis=0)
    weights = ridge.between(background, mean - background_mean, BETWEEN_RIDGE)
    contrast = float(weights @ (mean - background_mean))
    if not contrast > 0:
        raise BoxError("the object in the box looks like all that is around it: give another box, or another frame")
    weights /= np.float32(contrast)
    return Model(0, 0, weights, -float(weights @ background_mean))


def affine_copies(
    frame: Pyramid,
    window: Window,
    count: int,
    rng: np.random.Generator,
    vectors: VectorMap | None = None,
    *,
    context: float = 1.0,
    moved: float = 0.0,
    mirrored: int = 0,
) -> np.ndarray:
    """Features of a window and of copies of it, slightly scaled, shifted and rotated (paper, "System Implementation").

    All copies of one frame agree on the corners of the window, which are not the object: the share `moved` of the
    copies is put on another background of the frame. An object that turns shows another side, which often is the mirror
    image: the last copies, `mirrored` in number, are mirrored left to right. Returns float32 (count, d); the first row
    is that of the window itself, which is `context` times as large as the object's box. With a descriptor, the copies
    that are only scaled, shifted and rotated are sampled from its `vectors` around the window.
    """
    change = rng.normal(size=(count, 4))
    if count:
        change[0] = 0
    patches, of_vectors = [], []
    for number, (scale, right, down, turn) in enumerate(change):
        copy = _shifted(window, right, down).scaled(math.exp(_SCALE * scale))
        offset = _elsewhere(window, rng) if _is_moved(number, moved) else None
        is_mirrored = number >= max(count - mirrored, 1)
        patch = _patch(frame, copy, _TURN * turn, copy.box(context), offset)
        if is_mirrored:
            patch = patch[:, :, ::-1]
        patches.append(patch)
        if frame.descriptor is not None and (vectors is None or is_mirrored or offset is not None):
            of_vectors.append(
                _described(frame, frame.descriptor, copy, _TURN * turn, patch, offset, is_mirrored).row(copy)
            )
        elif vectors is not None:
            of_vectors.append(vectors.row(copy, _TURN * turn))
    return window_rows(patches, of_vectors)


def _is_moved(number: int, share: float) -> bool:
    """Whether copy `number` is put on another background: a `share` of all copies is, but never the first one."""
    return number > 0 and number * share % 1 < share


def _shifted(window: Window, right: float, down: float) -> Window:
    """A window shifted by multiples of the standard deviation of an affine copy's shift."""
    x, y = window.centre
    return window.centred(x + _SHIFT * right * window.w, y + _SHIFT * down * window.h)


def _elsewhere(window: Window, rng: np.random.Generator) -> tuple[float, float]:
    """A random offset of another background from a window, in pixels."""
    angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(_NEAREST_OTHER, _FARTHEST_OTHER)
    return far * math.cos(angle) * window.w, far * math.sin(angle) * window.h


def _patch(
    frame: Pyramid, window: Window, turn: float, box: Box, offset: tuple[float, float] | None = None
) -> np.ndarray:
    """A window and its margin, cut from a frame, rotated by `turn` radians and resized, uint8 (3, 96, 96).

    The object, whose box has the centre of the window, is put on another background `offset` pixels away; None leaves
    it.
    """
    pixel = window.w / (WINDOW * CELL), window.h / (WINDOW * CELL)
    x, y = window.centre
    patch = frame.cut(x, y, *pixel, _PATCH, turn)
    if offset is None:
        return patch
    share = _ellipse(window.w / box.w, window.h / box.h)
    background = frame.cut(x + offset[0], y + offset[1], *pixel, _PATCH, turn)
    return np.stack([cv2.blendLinear(*both, share, 1 - share) for both in zip(patch, background, strict=True)])


def _described(
    frame: Pyramid,
    descriptor: Descriptor,
    window: Window,
    turn: float,
    patch: np.ndarray,
    offset: tuple[float, float] | None,
    is_mirrored: bool = False,
) -> VectorMap:
    """The vectors of a patch, in the middle of the background around it."""
    (x, y), (right, down) = window.centre, offset or (0.0, 0.0)
    pixel = window.w / (WINDOW * CELL), window.h / (WINDOW * CELL)
    whole = frame.cut(x + right, y + down, *pixel, _DESCRIBED * CELL, turn)
    whole = whole[:, :, ::-1].copy() if is_mirrored else whole
    edge = (_DESCRIBED * CELL - _PATCH) // 2
    whole[:, edge:-edge, edge:-edge] = patch
    return VectorMap.of(descriptor, whole, window)


def _ellipse(across: float, down: float) -> np.ndarray:
    """Share of the object in each pixel of a patch, float32: 1 inside its ellipse, falling to 0 around it.

    The window is `across` times as wide, and `down` times as high as the object.
    """
    place = (np.arange(_PATCH) - (_PATCH - 1) / 2) / (WINDOW * CELL / 2)
    out = np.hypot((place * down)[:, None], place * across)
    share: np.ndarray = ((_GONE - out) / (_GONE - _SOLID)).clip(0, 1).astype(np.float32)
    return share


def _appearance(
    frame: Pyramid,
    window: Window,
    around: ScoreMap,
    model: Model | None,
    rng: np.random.Generator,
    teaching: TeachingSettings,
) -> TrainingRows:
    """The object, affine copies of it, near misses and background; half of this scores highest, if there is a model."""
    own = affine_copies(frame, window, 1 + teaching.copies, rng, around.vectors, mirrored=teaching.mirrored)
    rows = _rows(own, 1, _OBJECT_WEIGHT / len(own), teaching)
    hardest = 0 if model is None else _BACKGROUND // 2
    return rows + _surroundings(around, window, _BACKGROUND, hardest, rng, teaching)


def _surroundings(
    around: ScoreMap, window: Window, count: int, hardest: int, rng: np.random.Generator, teaching: TeachingSettings
) -> TrainingRows:
    """Near misses of a window, and `count` background windows: the `hardest` highest ones, the rest at random."""
    row, column = around.place(window)
    rows, columns = around.scores.shape
    down, across = abs(np.arange(rows) - row), abs(np.arange(columns) - column)
    outside = np.maximum.outer(down, across) > _NEAR + 0.5
    near, anywhere = np.flatnonzero(~outside), np.flatnonzero(outside)  # numbers of windows, row by row
    places, labels = [], []
    for number in near[rng.integers(len(near), size=teaching.near_misses)] if len(near) else ():
        place = divmod(int(number), columns)
        distance = math.hypot(down[place[0]], across[place[1]])
        if distance > _NEAREST:
            places.append(place)
            labels.append(_gaussian(distance, _NEAR_SIGMA))
    hard = non_maximum_suppression(np.where(outside, around.scores, -np.inf), hardest, _NEAR)
    drawn = rng.choice(anywhere, count - len(hard), replace=count > len(anywhere))
    background = [*hard, *(divmod(int(number), columns) for number in drawn)]
    return _rows(around.cells.rows([*places, *background]), [*labels, *[0.0] * len(background)], 1, teaching)


def _extents(
    frame: Pyramid, window: Window, vectors: VectorMap | None, rows: TrainingRows, settings: Settings
) -> Training:
    """Rows of group "extent": the first of `rows`, which fits, and windows of wrong extents."""
    trials = [trial for each in extent.trials(window, settings.extent) for trial in each]
    if not trials:
        return {}
    of_vectors = [] if vectors is None else [vectors.row(trial.window) for trial in trials]
    cuts = window_rows([frame.around(trial.window, WINDOW) for trial in trials], of_vectors)
    return {EXTENT: _fits([extent.Trial(window), *trials], np.vstack([rows.rows[:1], cuts]), 1, settings.teaching)}


def _first_extents(frame: Pyramid, window: Window, rng: np.random.Generator, settings: Settings) -> Training:
    """Rows of the same group from the first frame, more than fill a leaf: only there the box is certain.

    The windows are cut from shifted and rotated copies of the object, most of which are on another background.
    """
    kinds = extent.trials(window, settings.extent)
    cuts = [cut for kind in kinds for cut in _first_cuts(frame, window, [extent.Trial(window), *kind], rng, settings)]
    rows = window_rows([patch for _, patch, _ in cuts], [row for _, _, row in cuts if row is not None])
    return {EXTENT: _fits([trial for trial, _, _ in cuts], rows, 1 / len(kinds), settings.teaching)} if kinds else {}


def _first_cuts(
    frame: Pyramid, window: Window, trials: list[extent.Trial], rng: np.random.Generator, settings: Settings
) -> Iterator[tuple[extent.Trial, np.ndarray, np.ndarray | None]]:
    """Trials at copies of the object in the first frame, each with its patch, and with its vectors.

    A descriptor computes the vectors of the first trial at each copy, from which those of the others are sampled.
    """
    for number in range(math.ceil(settings.coreset.size / len(trials))):
        right, down, turn = rng.normal(size=3) if number else np.zeros(3)
        copy = _shifted(window, right, down)
        offset = _elsewhere(window, rng) if _is_moved(number, settings.teaching.other_backgrounds) else None
        vectors = None
        for trial in trials:
            tried = trial.window.centred(*copy.centre)
            patch = _patch(frame, tried, _TURN * turn, copy.box(settings.search.context), offset)
            if frame.descriptor is not None and vectors is None:
                vectors = _described(frame, frame.descriptor, tried, _TURN * turn, patch, offset)
            yield trial, patch, None if vectors is None else vectors.row(tried)


def _fits(trials: Sequence[extent.Trial], cuts: np.ndarray, weight: float, teaching: TeachingSettings) -> TrainingRows:
    """Rows of group "extent" from trials and the feature row of each."""
    labels = [_gaussian(trial.larger + trial.wider, _EXTENT_SIGMA) for trial in trials]  # one of the two is 0
    offsets = [(extent.offset_label(trial.larger), extent.offset_label(trial.wider)) for trial in trials]
    return replace(_rows(cuts, labels, weight, teaching), offsets=np.array(offsets, np.float32))


def _gaussian(offset: float, sigma: float) -> float:
    """Label of a window at an offset from the right one: exp(-offset^2 / (2 sigma^2))."""
    return math.exp(-((offset / sigma) ** 2) / 2)


def _rows(rows: np.ndarray, labels: float | list[float], weight: float, teaching: TeachingSettings) -> TrainingRows:
    """Training rows of one weight; the histogram of colours is 0 unless it is used: then no model weighs it."""
    if not teaching.colours:
        rows = rows.copy()
        rows[:, COLOURS] = 0
    return TrainingRows.labelled(rows, labels, weight)
