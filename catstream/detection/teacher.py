"""The teacher: the windows of a frame that become training rows, and their labels.

A row of the object has the label 1, a row of the background 0. Between them are near misses, which are windows next to
the object, and windows of the object of a wrong size or aspect ratio. Their label is a Gaussian of the offset, so that
the score falls smoothly around the right window. Windows of wrong extents have a second label, the error of their size
or aspect ratio. The initial model is trained on the rows of the first frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from catstream.base import ridge
from catstream.base.box import Box, Window
from catstream.base.settings import Settings, TrainingSettings
from catstream.detection import extent
from catstream.detection.context import FrameContext
from catstream.detection.search import due_part
from catstream.detection.similarity import MIN_SIMILARITY, Similarity
from catstream.errors import BoxError
from catstream.features.cells import window_rows
from catstream.features.layout import CELL, COLOURS, MARGIN, WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap, non_maximum_suppression
from catstream.wire.heads import APPEARANCE, DISCRIMINANT_RIDGE, EXTENT
from catstream.wire.messages import Model, TrainingRows

#: Training rows by group, as in `Features`; a group without rows is left out.
Training = dict[str, TrainingRows]

_NEAR_MISSES = 6  # in each frame; 12 gain nothing and cost time
_NEAR = 2  # distance in cells up to which a window is a near miss, not background
_MIN_DISTANCE = 0.9  # of a near miss, in cells: a nearer window fits the object as well
_NEAR_SIGMA = 0.9  # standard deviation of the Gaussian label of a near miss, in cells
_EXTENT_SIGMA = 1.0  # for the label of a wrong extent, in steps of size or aspect ratio
_EXTENT_INTERVAL = 2  # frames from one set of windows of wrong extents to the next
_OBJECT_WEIGHT = 8.0  # sum of the weights of a frame's rows of the object; any other row has weight 1
_BACKGROUND = 12  # background windows around the object in a frame
_SIDE = 20  # side, in cells, of the smallest region around the object from which background is cut
_MINING_INTERVAL = 8  # frames between two searches for hard negatives; a large frame is searched in parts
_MAX_CELLS = 4096  # limit of a search for hard negatives in one frame: about 4 ms
_MAX_OVERLAP = 0.2  # IoU of a hard negative with the object's window

_PATCH = (WINDOW + 2 * MARGIN) * CELL  # side of a copy with its margin, in pixels
_SCALE, _SHIFT, _ROTATION = (
    0.03,
    0.02,
    0.05,
)  # standard deviations of affine copies: a factor, a share of the box, radians
_MIRRORED = 1  # number of a frame's copies that are flipped: a rotated object may look like its mirror image
_MOVED = 0.9  # share of the first frame's copies on another background, so that models do not learn it; 0.5 gains less
_MIN_OFFSET, _MAX_OFFSET = 0.3, 1.0  # distance of another background, in windows
# Radii of the object's ellipse between which a copy fades into another background; 1 touches the sides of its box.
_OPAQUE, _TRANSPARENT = 0.8, 1.15


def first_training(
    frame: Pyramid, window: Window, rng: np.random.Generator, settings: Settings
) -> tuple[Model, Training]:
    """Train the initial model on the rows of the first frame, which fill a leaf of each tree; returns both.

    If SCM tracks the object first, the group "appearance" has only the rows of an ordinary frame. BoxError if object
    and background are indistinguishable.
    """
    options = settings.training
    count = settings.coreset.size
    around = ScoreMap.around(frame, window, _SIDE, None)
    if options.bootstrap == "scm":
        rows = _appearance(frame, window, around, rng, options, hardest=0)
    else:
        copies = affine_copies(frame, window, count, rng, moved=_MOVED if options.augment else 0.0)
        rows = _rows(copies, 1, _OBJECT_WEIGHT, options)
        rows += _surroundings(around, window, count, 0, rng, options)
    training = _first_extents(frame, window, rng, settings)
    rows += hard_negatives(FrameContext(frame, initial_model(rows), settings), window)
    return initial_model(rows), {APPEARANCE: rows, **training}


def training_of(context: FrameContext, window: Window, around: ScoreMap | None) -> Training:
    """The rows of a frame in which the object was detected, cut around its window.

    Windows of wrong extents are cut in every second frame. Hard negatives are searched in a part of the frame at a
    time. The parts have equal shares of the rows, so the number of rows over many frames does not depend on the
    number of parts.
    """
    training = training_at(context, window, around, extents=context.seq % _EXTENT_INTERVAL == 0)
    options = context.settings.training
    parts = context.pyramid.region_around(window).split(window, _MAX_CELLS)
    number = due_part(context.seq, _MINING_INTERVAL, len(parts))
    if number is None:
        return training
    # A round of all parts yields hard_negatives / _MINING_INTERVAL rows per frame on average.
    rows = options.hard_negatives * max(len(parts), _MINING_INTERVAL)
    shares = len(parts) * _MINING_INTERVAL
    if count := (number + 1) * rows // shares - number * rows // shares:
        hardest = _hardest(context.scores_within(parts[number], window), window, count)
        training[APPEARANCE] += _rows(hardest, 0, 1, options)
    return training


def training_at(
    context: FrameContext, window: Window, around: ScoreMap | None = None, *, extents: bool = True
) -> Training:
    """The rows of an object at a window, with rows of group "extent" if `extents`.

    Near misses and background are cut from the windows `around` it, if a search scored enough of them.
    """
    settings = context.settings
    rng = np.random.default_rng((settings.run.seed, context.seq))  # per frame, so that a restart repeats the rows
    if around is None or min(around.cells.shape) < _SIDE:
        around = context.scores_around(window, _SIDE)
    rows = _appearance(context.pyramid, window, around, rng, settings.training, hardest=_BACKGROUND // 2)
    training = {APPEARANCE: rows}
    if extents:
        training |= _extents(context.pyramid, window, rows, settings)
    return training


def training_of_background(context: FrameContext, window: Window, similarity: Similarity) -> Training:
    """The rows of a frame before the first detection of a saved model's object: background of a new scene.

    They are windows with a high score, except windows similar to the object, and the best one, which may be the object.
    """
    settings = context.settings
    scores = context.scores_of_frame(window)
    rows = _hardest(scores, window, settings.training.hard_negatives, settings.belief.weak_score)
    dissimilar = rows[[similarity(row) < MIN_SIMILARITY for row in rows]]
    return {APPEARANCE: _rows(dissimilar, 0, 1, settings.training)} if len(dissimilar) else {}


def hard_negatives(context: FrameContext, window: Window) -> TrainingRows:
    """The windows of the frame with the highest scores that do not overlap the object's window."""
    options = context.settings.training
    return _rows(_hardest(context.scores_of_frame(window), window, options.hard_negatives), 0, 1, options)


def _hardest(scores: ScoreMap, window: Window, count: int, threshold: float = -math.inf) -> np.ndarray:
    """The rows, float32 (k, d), of up to `count` windows with the highest scores above a threshold.

    They are selected by non-maximum suppression, and hardly overlap `window`.
    """
    maxima = non_maximum_suppression(scores.scores, count + 1, WINDOW // 2, threshold)
    return scores.cells.rows([cell for cell in maxima if scores.window(*cell).overlap(window) < _MAX_OVERLAP][:count])


def initial_model(rows: TrainingRows) -> Model:
    """A model of version 0: the linear discriminant of the object's mean against the background.

    BoxError if the two are indistinguishable.
    """
    background = rows.rows[rows.labels == 0]
    background_mean = background.mean(axis=0)
    difference = rows.rows[rows.labels == 1].mean(axis=0) - background_mean
    weights = ridge.discriminant(background, difference, DISCRIMINANT_RIDGE)
    contrast = float(weights @ difference)
    if not contrast > 0:
        raise BoxError(
            "the object is indistinguishable from its background in this frame: choose another box or another frame"
        )
    weights /= np.float32(contrast)
    return Model(0, 0, weights, -float(weights @ background_mean))


def affine_copies(
    frame: Pyramid,
    window: Window,
    count: int,
    rng: np.random.Generator,
    *,
    moved: float = 0.0,
    mirrored: int = 0,
) -> np.ndarray:
    """Features of a window and of affine copies: slightly scaled, shifted, rotated (paper, "System Implementation").

    The corners of the window show background, the same in all copies: a share `moved` of the copies is put on another
    background of the frame. The other side of an object is often its mirror image: the last `mirrored` copies are
    flipped left to right. Returns float32 (count, d); the first row is the window itself.
    """
    changes = rng.normal(size=(count, 4))
    if count:
        changes[0] = 0
    patches = []
    for number, (scale, right, down, angle) in enumerate(changes):
        copy = _shifted(window, right, down).scaled(math.exp(_SCALE * scale))
        offset = _random_offset(window, rng) if _is_moved(number, moved) else None
        patch = _patch(frame, copy, _ROTATION * angle, copy.box(), offset)
        patches.append(patch[:, :, ::-1] if number >= max(count - mirrored, 1) else patch)
    return window_rows(patches)


def _is_moved(number: int, share: float) -> bool:
    """Return True if copy `number` gets another background, as a `share` of all copies do, but never the first one."""
    return number > 0 and number * share % 1 < share


def _shifted(window: Window, right: float, down: float) -> Window:
    """A window shifted by multiples of the standard deviation of an affine copy's shift."""
    x, y = window.centre
    return window.centred(x + _SHIFT * right * window.w, y + _SHIFT * down * window.h)


def _random_offset(window: Window, rng: np.random.Generator) -> tuple[float, float]:
    """A random offset of another background from a window, in pixels."""
    angle = rng.uniform(0, 2 * np.pi)
    distance = rng.uniform(_MIN_OFFSET, _MAX_OFFSET)
    return distance * math.cos(angle) * window.w, distance * math.sin(angle) * window.h


def _patch(
    frame: Pyramid, window: Window, angle: float, box: Box, offset: tuple[float, float] | None = None
) -> np.ndarray:
    """Cut a window and its margin from a frame, rotate them by `angle` radians and resize them to uint8 (3, 96, 96).

    With an offset in pixels, the object, whose box has the centre of the window, is blended into the background at that
    offset.
    """
    pixel = window.w / (WINDOW * CELL), window.h / (WINDOW * CELL)
    x, y = window.centre
    patch = frame.cut(x, y, *pixel, _PATCH, angle)
    if offset is None:
        return patch
    share = _share(window.h / box.h, window.w / box.w)
    background = frame.cut(x + offset[0], y + offset[1], *pixel, _PATCH, angle)
    channels = zip(patch, background, strict=True)
    return np.stack([cv2.blendLinear(*pair, share, 1 - share) for pair in channels])


@lru_cache(maxsize=64)  # most copies of a frame have the same ratios
def _share(down: float, across: float) -> np.ndarray:
    """The share of the object in each pixel of a patch, by the ratios of window and box: 1 inside its ellipse."""
    position = (np.arange(_PATCH) - (_PATCH - 1) / 2) / (WINDOW * CELL / 2)
    radius = np.hypot((position * down)[:, None], position * across)
    share: np.ndarray = ((_TRANSPARENT - radius) / (_TRANSPARENT - _OPAQUE)).clip(0, 1).astype(np.float32)
    return share


def _appearance(
    frame: Pyramid,
    window: Window,
    around: ScoreMap,
    rng: np.random.Generator,
    options: TrainingSettings,
    *,
    hardest: int,
) -> TrainingRows:
    """Rows of the object, of affine copies of it, of near misses and of background, `hardest` of it by score."""
    own = affine_copies(frame, window, 1 + options.copies, rng, mirrored=_MIRRORED if options.augment else 0)
    rows = _rows(own, 1, _OBJECT_WEIGHT / len(own), options)
    return rows + _surroundings(around, window, _BACKGROUND, hardest, rng, options)


def _surroundings(
    around: ScoreMap, window: Window, count: int, hardest: int, rng: np.random.Generator, options: TrainingSettings
) -> TrainingRows:
    """Near misses of a window, and `count` background windows: `hardest` with the highest scores, and random ones."""
    row, column = around.position(window)
    rows, columns = around.scores.shape
    down = abs(np.arange(rows) - row)
    across = abs(np.arange(columns) - column)
    is_background = np.maximum.outer(down, across) > _NEAR + 0.5
    near, far = np.flatnonzero(~is_background), np.flatnonzero(is_background)  # indices of windows, row by row
    near_misses, labels = [], []
    for index in near[rng.integers(len(near), size=_NEAR_MISSES)] if len(near) else ():
        cell = divmod(int(index), columns)
        distance = math.hypot(down[cell[0]], across[cell[1]])
        if distance > _MIN_DISTANCE:
            near_misses.append(cell)
            labels.append(_gaussian(distance, _NEAR_SIGMA))
    hard = non_maximum_suppression(np.where(is_background, around.scores, -np.inf), hardest, _NEAR)
    random = rng.choice(far, count - len(hard), replace=count > len(far))
    background = [*hard, *(divmod(int(index), columns) for index in random)]
    return _rows(around.cells.rows([*near_misses, *background]), [*labels, *[0.0] * len(background)], 1, options)


def _extents(frame: Pyramid, window: Window, rows: TrainingRows, settings: Settings) -> Training:
    """Rows of group "extent": the first of `rows`, whose window fits, and windows of wrong extents."""
    trials = [trial for kind in extent.trials(window, settings.extent) for trial in kind]
    if not trials:
        return {}
    cuts = window_rows([frame.around(trial.window, WINDOW) for trial in trials])
    return {EXTENT: _fits([extent.Trial(window), *trials], np.vstack([rows.rows[:1], cuts]), 1, settings.training)}


def _first_extents(frame: Pyramid, window: Window, rng: np.random.Generator, settings: Settings) -> Training:
    """Rows of group "extent" from the first frame, enough to fill a leaf, because only there the box is certain.

    The windows are cut from shifted and rotated copies of the object, most of which are on another background.
    """
    kinds = extent.trials(window, settings.extent)
    moved = _MOVED if settings.training.augment else 0.0
    trials, patches = [], []
    for kind in kinds:
        for number in range(math.ceil(settings.coreset.size / (1 + len(kind)))):
            right, down, angle = rng.normal(size=3) if number else np.zeros(3)
            copy = _shifted(window, right, down)
            offset = _random_offset(window, rng) if _is_moved(number, moved) else None
            for trial in (extent.Trial(window), *kind):
                trials.append(trial)
                patches.append(_patch(frame, trial.window.centred(*copy.centre), _ROTATION * angle, copy.box(), offset))
    return {EXTENT: _fits(trials, window_rows(patches), 1 / len(kinds), settings.training)} if kinds else {}


def _fits(trials: Sequence[extent.Trial], cuts: np.ndarray, weight: float, options: TrainingSettings) -> TrainingRows:
    """Rows of group "extent" of trials, from their feature rows."""
    labels = [_gaussian(trial.larger + trial.wider, _EXTENT_SIGMA) for trial in trials]  # one of the two is 0
    offsets = [(extent.offset_label(trial.larger), extent.offset_label(trial.wider)) for trial in trials]
    return replace(_rows(cuts, labels, weight, options), offsets=np.array(offsets, np.float32))


def _gaussian(offset: float, sigma: float) -> float:
    """Label of a window at an offset from the right one: exp(-offset^2 / (2 sigma^2))."""
    return math.exp(-((offset / sigma) ** 2) / 2)


def _rows(rows: np.ndarray, labels: float | list[float], weight: float, options: TrainingSettings) -> TrainingRows:
    """Training rows of one weight. Without `training.colours`, the histogram of colours is set to 0."""
    if not options.colours:
        rows = rows.copy()
        rows[:, COLOURS] = 0
    return TrainingRows.labelled(rows, labels, weight)
