"""The search of files for the objects of saved models: frames in equal distances of time, and what is seen in them.

All models are searched on one grid of sizes and aspect ratios. For each entry of the grid, a frame is resized and its
cells are computed once, for all models whose objects may have this size and shape.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
from collections import defaultdict, deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from catstream.base.box import Box, Window
from catstream.base.settings import RunSettings, Settings
from catstream.base.threads import cores, one_thread
from catstream.detection.context import FrameContext
from catstream.detection.search import SAME_OVERLAP, fit_extent
from catstream.detection.search import Detection as Candidate
from catstream.detection.similarity import Similarity
from catstream.errors import SettingsError, VideoError
from catstream.features.cells import Cells
from catstream.features.layout import CELL, WINDOW
from catstream.features.pyramid import Pyramid
from catstream.features.score_map import ScoreMap, non_maximum_suppression
from catstream.finding.files import File, NamedFrame, Reading, find_files
from catstream.jobs.saved_model import SavedModel
from catstream.messages.kinds import Model
from catstream.video.frames import Frame

_One = TypeVar("_One", bound=str | os.PathLike[str] | SavedModel)

#: Seconds of a video between two frames that are searched.
EVERY = 0.2
#: The minimum score of a detection.
THRESHOLD = 0.5
#: The smallest and the largest size that is searched, as multiples of the learned size.
SIZES = (0.4, 2.5)

_SIZE_STEP = 1.25  # ratio of successive sizes of the grid
_ASPECT_STEP = 1.25  # ratio of successive aspect ratios
_MOST_PIXELS = 4_000_000  # of a resized frame: bounds the cost of a search for a tiny object in a large frame
_WIDEST = 1.25  # of a window, as a multiple of the frame: its object fills the frame
_SMALLEST = 24  # side of a window in pixels: a smaller one shows too little of its object
_MOST_MAXIMA = 8  # windows of one size that are examined, and detections of one object in a frame
_FITTED = 0.7  # share of the threshold from which a window is fitted: its score rises by less

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Detection:
    """An object that was detected in a frame.

    Attributes
    ----------
    object : str
        Name of the object.
    file : str
        The video, the image, or the folder of images.
    frame : int
        Number of the frame, or of the image in its folder; the first one is 0.
    time : float
        Seconds since the start of the video.
    box : Box
        Box of the object in pixels of the frame.
    score : float
        About 1 on the object, near 0 elsewhere; at least the threshold of the search.
    image : str
        Name of the file in a folder of images, otherwise empty.
    """

    object: str
    file: str
    frame: int
    time: float
    box: Box
    score: float
    image: str = ""


@dataclass(frozen=True, slots=True)
class Match:
    """A window that shows an object, the object's box in it, and the score: see `Scan`."""

    window: Window
    box: Box
    score: float


@dataclass(frozen=True, slots=True)
class _Template:
    """A model, its measure of similarity, a window of the learned size, and the settings that it was learned with."""

    model: Model
    similarity: Similarity
    window: Window
    settings: Settings

    @classmethod
    def of(cls, saved: SavedModel) -> Self:
        return cls(saved.model, saved.similarity(), Window.around(saved.box), saved.settings)

    def match(self, scores: ScoreMap, row: int, column: int, window: Window) -> Match:
        """The match of a window whose features are at (row, column) of a map of appearance scores."""
        score = min(1.0, float(scores.scores[row, column])) * self.similarity(scores.cells.row(row, column))
        return Match(window, window.box(), score)


class Scan:
    """Searches frames for the objects of several models.

    The score of a window is its similarity to the object (see `catstream.detection.similarity`) times the score of the
    appearance model, clipped at 1: about 1 on the object, and near 0 on an unknown background.

    threshold : minimum score of a detection
    sizes : smallest and largest size, as multiples of the learned size
    """

    def __init__(
        self,
        models: Iterable[SavedModel],
        threshold: float = THRESHOLD,
        sizes: tuple[float, float] = SIZES,
    ) -> None:
        self._threshold = threshold
        self._templates = [_Template.of(saved) for saved in models]
        self._grid: dict[tuple[int, int], list[int]] = defaultdict(list)  # entry -> numbers of the models
        for number, template in enumerate(self._templates):
            for entry in _entries(template.window, sizes):
                self._grid[entry].append(number)

    @one_thread()
    def __call__(self, image: np.ndarray) -> list[list[Match]]:
        """Search a frame, uint8 (h, w, 3): for each model, fitted windows that do not overlap, best first."""
        frame = Pyramid(image)
        results = []
        for template, windows in zip(self._templates, self.windows(frame), strict=True):
            matches = (_fitted(frame, candidate.window, template) for candidate in windows)
            results.append(_suppressed(match for match in matches if match.score >= self._threshold))
        return results

    def windows(self, frame: Pyramid) -> list[list[Match]]:
        """For each model, the best windows of the grid, highest score first."""
        matches: list[list[Match]] = [[] for _ in self._templates]
        for entry, numbers in self._grid.items():
            window = _window(*entry)
            if not _is_searchable(window, frame.size):
                continue
            image, step = frame.resized(window, averaged=False)
            cells = Cells.of(image)
            for number in numbers:
                matches[number] += self._maxima(cells, step, self._templates[number])
        return [_suppressed(of_model) for of_model in matches]

    def _maxima(self, cells: Cells, step: tuple[float, float], template: _Template) -> list[Match]:
        """The best windows of one size, whose cells are `step` pixels wide and high."""
        least = _FITTED * self._threshold
        model = template.model
        # No similarity is above 1 / share.
        appearance = cells.respond_above(model.weights, model.bias, least * template.similarity.share)
        scores = ScoreMap(cells, appearance, (0.0, 0.0), step)
        places = non_maximum_suppression(appearance, _MOST_MAXIMA, WINDOW // 2)
        matches = [template.match(scores, *place, scores.window(*place)) for place in places]
        return [match for match in matches if match.score >= least]


def _fitted(frame: Pyramid, window: Window, template: _Template) -> Match:
    """A window at its best size and aspect ratio; the learned aspect ratio is likelier than others."""
    size = math.sqrt(window.area / template.window.area)
    likely = template.window.scaled(size).centred(*window.centre)
    context = FrameContext(frame, template.model, template.settings)
    best = fit_extent(context, Candidate(0.0, window), likely).window
    return template.match(ScoreMap.around(frame, best, WINDOW, template.model), 0, 0, best)


def _entries(window: Window, sizes: tuple[float, float]) -> list[tuple[int, int]]:
    """The entries of the grid, exponents of size and aspect ratio, at which the object of a window is searched."""
    low, high = (math.log(math.sqrt(window.area) * size, _SIZE_STEP) for size in sizes)
    aspect = round(math.log(window.w / window.h, _ASPECT_STEP))
    return [(size, aspect) for size in range(math.ceil(low), math.floor(high) + 1)] or [(round(low), aspect)]


def _window(size: int, aspect: int) -> Window:
    """The window of an entry of the grid."""
    side, stretch = _SIZE_STEP**size, math.sqrt(_ASPECT_STEP**aspect)
    return Window(0.0, 0.0, side * stretch, side / stretch)


def _is_searchable(window: Window, size: tuple[int, int]) -> bool:
    """Return True if windows of a size are neither too small to show anything nor too large for a frame."""
    (width, height), side = size, WINDOW * CELL
    if window.w > _WIDEST * width or window.h > _WIDEST * height or window.area < _SMALLEST**2:
        return False
    return width * side / window.w * height * side / window.h <= _MOST_PIXELS


def _suppressed(matches: Iterable[Match]) -> list[Match]:
    """Non-maximum suppression: the windows that overlap no better one, highest score first."""
    best: list[Match] = []
    for match in sorted(matches, key=lambda match: -match.score):
        if len(best) < _MOST_MAXIMA and all(match.window.overlap(other.window) < SAME_OVERLAP for other in best):
            best.append(match)
    return best


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A frame that was searched, and the objects that were found in it."""

    frame: Frame
    detections: list[Detection]


@dataclass(slots=True)
class Search:
    """Searches files for the objects of several models, in as many threads as there are cores.

    models      name of each object -> its model
    settings    for reading files: the frame rate of images, and whether damage is skipped
    threshold   minimum score of a detection
    every       seconds of a video between two frames that are searched, 0 for every frame
    sizes       smallest and largest size that is searched, as multiples of the learned size
    """

    models: Mapping[str, SavedModel]
    settings: RunSettings = field(default_factory=RunSettings)
    threshold: float = THRESHOLD
    every: float = EVERY
    sizes: tuple[float, float] = SIZES
    _scan: Scan = field(init=False)

    def __post_init__(self) -> None:
        low, high = self.sizes
        if not 0 < low <= high < 100:
            raise SettingsError(f"expected the smallest and the largest size, got {low:g},{high:g}: for example 0.5,2")
        self._scan = Scan(self.models.values(), self.threshold, self.sizes)

    @property
    def description(self) -> dict[str, Any]:
        """Models and options, as values of JSON: two searches with the same description have the same results."""
        return {
            "models": {name: _digest(saved) for name, saved in self.models.items()},
            "threshold": self.threshold,
            "every": self.every,
            "sizes": list(self.sizes),
            "image_rate": self.settings.image_rate,
            "skip_damaged": self.settings.skip_damaged,
        }

    def file(self, file: File, reading: Reading | None = None) -> Iterator[Step]:
        """Search a file. At damage of a video, VideoError is raised after the steps before it."""
        frames = file.frames(self.every, self.settings, reading or Reading())
        with closing(frames), closing(_scanned(self._scan, frames)) as scanned:
            for (frame, image), results in scanned:
                place = str(file.path), frame.number, frame.time
                detections = [
                    Detection(name, *place, match.box, match.score, image)
                    for name, matches in zip(self.models, results, strict=True)
                    for match in matches
                ]
                yield Step(frame, detections)


def find(
    models: str | os.PathLike[str] | SavedModel | Iterable[str | os.PathLike[str] | SavedModel],
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    threshold: float = THRESHOLD,
    every: float = EVERY,
    sizes: tuple[float, float] = SIZES,
    skip_damaged: bool = False,
) -> Iterator[Detection]:
    """Find the objects of saved models in videos, folders and images.

    Parameters
    ----------
    models : path, or iterable of paths
        Files that `catstream save` wrote. An object without a name gets that of its file.
    paths : path, or iterable of paths
        Videos, images, and folders, which are searched with all their subfolders.
    threshold : float
        Minimum score of a detection; the score is about 1 on the object.
    every : float
        Seconds of a video between two frames that are searched, 0 for every frame.
    sizes : two floats
        Smallest and largest size that is searched, as multiples of the size that was learned.
    skip_damaged : bool
        Continue after a damaged place in a video.

    Yields
    ------
    Detection
        Files in the order of `paths`, frames in order, objects in the order of `models`, highest score first.

    Raises
    ------
    ServiceError, ProtocolError
        If a model does not exist, or is damaged or of other features.
    SettingsError
        If two models have one name, the sizes are not positive, the smaller one first.
    VideoError
        If a path does not exist or has nothing to search; after all other files, for the first file that is damaged.

    Examples
    --------
    >>> for detection in find("dahlia.safetensors", "holiday/"):  # doctest: +SKIP
    ...     print(detection.file, detection.time, detection.box, detection.score)
    """
    reading = RunSettings(skip_damaged=skip_damaged)
    search = Search(load_models(_several(models)), reading, threshold, every, sizes)
    return _detections(search, find_files(_several(paths)))


def load_models(models: Iterable[str | os.PathLike[str] | SavedModel]) -> dict[str, SavedModel]:
    """Load models; return each by the name of its object, or of its file."""
    named: dict[str, SavedModel] = {}
    for number, model in enumerate(models, 1):
        saved = model if isinstance(model, SavedModel) else SavedModel.load(model)
        name = saved.object or (f"object-{number}" if isinstance(model, SavedModel) else Path(model).stem)
        if name in named:
            raise SettingsError(f"duplicate model name {name!r}: rename the file of one, or save it under another name")
        named[name] = saved
    if not named:
        raise SettingsError("missing model: pass a saved model (`catstream save`, `catstream track --save-model`)")
    return named


def _digest(saved: SavedModel) -> str:
    """A digest of weights, bias and size."""
    digest = hashlib.sha256(saved.model.weights.tobytes())
    digest.update(np.array([saved.model.bias, *saved.box[2:]]).tobytes())
    return digest.hexdigest()[:16]


def _detections(search: Search, files: list[File]) -> Iterator[Detection]:
    problems: list[VideoError] = []
    for file in files:
        reading = Reading()
        try:
            for step in search.file(file, reading):
                yield from step.detections
        except VideoError as error:
            problems.append(error)
        if file.kind != "video":  # of a video, the caller asked to skip them
            problems += map(VideoError, reading.problems)
    if problems:
        raise problems[0]


def _several(values: _One | Iterable[_One]) -> Iterable[_One]:
    """One value or several, as several."""
    return [values] if isinstance(values, str | os.PathLike | SavedModel) else values


def _scanned(scan: Scan, frames: Iterator[NamedFrame]) -> Generator[tuple[NamedFrame, list[list[Match]]]]:
    """Scan frames in several threads, and yield the results in order; an error of the source comes after them."""
    workers = cores()
    pending: deque[tuple[NamedFrame, Future[list[list[Match]]]]] = deque()
    problem: VideoError | None = None
    with ThreadPoolExecutor(workers, "scan") as pool:
        try:
            for named_frame in frames:
                pending.append((named_frame, pool.submit(scan, named_frame[0].image)))
                if len(pending) > workers:
                    first, matches = pending.popleft()
                    yield first, matches.result()
        except VideoError as error:
            problem = error
        for named_frame, matches in pending:
            yield named_frame, matches.result()
    if problem is not None:
        raise problem
