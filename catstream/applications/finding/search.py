"""The search of files for objects: frames in equal distances of time, and the frame in which an object appears."""

from __future__ import annotations

import hashlib
import math
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from catstream.applications.finding.files import File, find_files
from catstream.applications.finding.scan import SIZES, THRESHOLD, Scan, Seen
from catstream.applications.finding.sightings import Sighting
from catstream.errors import SettingsError, VideoError
from catstream.run.learned import Learned
from catstream.settings import RunSettings
from catstream.video.frames import Frame

_One = TypeVar("_One", bound=str | os.PathLike[str] | Learned)

#: Seconds of a video between two frames that are searched.
EVERY = 0.2

_MOST_BETWEEN = 16  # frames between two that are searched, which are kept for the bisection: bounds the memory


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A frame that is searched, and the frames between it and the previous one that is searched.

    image  name of the frame's file in a folder of images
    """

    frame: Frame
    between: Sequence[Frame] = ()
    image: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """The result for a frame, and for those before it.

    frame      number of the frame: a search that is interrupted after this step continues from it
    time       its time in seconds
    sightings  in this frame and in frames between the previous step and it, in the order of the frames
    images     the image of each sighting, uint8 (h, w, 3) BGR
    """

    frame: int
    time: float
    sightings: Sequence[Sighting]
    images: Sequence[np.ndarray]


@dataclass(slots=True)
class Search:
    """Searches files for the objects of several models.

    Of a video, one frame in `every` seconds is searched. If an object is seen in only one of two successive frames, the
    frame in which it appears or disappears is determined by bisection of the frames between them. Each image of a
    folder is searched. There are as many threads as cores.

    models      name of each object -> its model
    settings    for reading files: the frame rate of images, and whether damage is skipped
    threshold   least score of a sighting
    every       seconds of a video between two frames that are searched, 0 for every frame
    sizes       smallest and largest size that is searched, as multiples of the learned size
    """

    models: Mapping[str, Learned]
    settings: RunSettings = field(default_factory=RunSettings)
    threshold: float = THRESHOLD
    every: float = EVERY
    sizes: tuple[float, float] = SIZES
    _scan: Scan = field(init=False)

    def __post_init__(self) -> None:
        low, high = self.sizes
        if not 0 < low <= high < 100:
            raise SettingsError(f"expected two positive sizes, the smaller one first, got {low:g},{high:g}: give 0.5,2")
        self._scan = Scan(self.models.values(), self.threshold, self.sizes)

    @property
    def description(self) -> dict[str, Any]:
        """Models and options, as values of JSON: two searches with the same description have the same results."""
        return {
            "models": {name: _digest(learned) for name, learned in self.models.items()},
            "threshold": self.threshold,
            "every": self.every,
            "sizes": list(self.sizes),
            "image_rate": self.settings.image_rate,
            "skip_damaged": self.settings.skip_damaged,
        }

    def file(
        self,
        file: File,
        after: int | None = None,
        *,
        opened: Callable[[float, int | None], None] = lambda *_: None,
        damaged: Callable[[str], None] = lambda _: None,
    ) -> Iterator[Step]:
        """Search a file.

        Parameters
        ----------
        after : frame of the last step of an earlier search, which is continued; None to begin
        opened, damaged : as in `File.frames`

        Raises
        ------
        VideoError
            At damage, after the steps before it.
        """
        before: list[list[Seen]] | None = None
        stretches = self._stretches(file, after or 0, opened, damaged)
        with closing(stretches), closing(_scanned(self._scan, stretches)) as scanned:
            for stretch, found in scanned:
                frames: list[tuple[Frame, list[list[Seen]]]] = [(stretch.frame, found)]
                if before is not None:
                    frames = [*_bisected(self._scan, before, stretch, found), *frames]
                if before is not None or after is None:
                    yield self._step(file, stretch, frames)
                before = found

    def _stretches(
        self,
        file: File,
        start: int,
        opened: Callable[[float, int | None], None],
        damaged: Callable[[str], None],
    ) -> Generator[_Stretch]:
        """The frames to search. The first and the last frame of a file are among them."""
        interval = 1

        def begin(rate: float, frames: int | None) -> None:
            nonlocal interval
            if file.kind == "video":
                interval = max(1, round(self.every * rate))
            opened(rate, frames)

        between: list[Frame] = []
        last: Frame | None = None
        for frame, image in file.frames(start, self.settings, begin, damaged):
            if frame.number == start or frame.number % interval == 0:
                yield _Stretch(frame, between, image)
                between, last = [], None
                continue
            last = frame
            if frame.number % math.ceil(interval / _MOST_BETWEEN) == 0:
                between.append(frame)
        if last is not None:
            yield _Stretch(last, [frame for frame in between if frame is not last])

    def _step(self, file: File, stretch: _Stretch, frames: list[tuple[Frame, list[list[Seen]]]]) -> Step:
        sightings, images = [], []
        for frame, found in frames:
            for name, detections in zip(self.models, found, strict=True):
                for each in detections:
                    place = str(file.path), frame.number, frame.time, each.box
                    sightings.append(Sighting(name, *place, each.score, stretch.image))
                    images.append(frame.image)
        return Step(stretch.frame.number, stretch.frame.time, sightings, images)


def find(
    models: str | os.PathLike[str] | Learned | Iterable[str | os.PathLike[str] | Learned],
    paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    *,
    threshold: float = THRESHOLD,
    every: float = EVERY,
    sizes: tuple[float, float] = SIZES,
    skip_damaged: bool = False,
) -> Iterator[Sighting]:
    """Find the objects of saved models in videos, folders and images.

    Parameters
    ----------
    models : path, or iterable of paths
        Files that `catstream save` wrote. An object without a name gets that of its file.
    paths : path, or iterable of paths
        Videos, images, and folders, which are searched with all their subfolders.
    threshold : float
        Least score of a sighting; the score is about 1 on the object.
    every : float
        Seconds of a video between two frames that are searched, 0 for every frame. The frame in which an object appears
        or disappears is found in any case.
    sizes : two floats
        Smallest and largest size that is searched, as multiples of the size that was learned.
    skip_damaged : bool
        Continue after a damaged place in a video.

    Yields
    ------
    Sighting
        Files in the order of `paths`, frames in order, objects in the order of `models`, highest score first.

    Raises
    ------
    ServiceError, ProtocolError
        If a model does not exist, or is damaged or of other features.
    SettingsError
        If two models have one name, or the sizes are not positive, the smaller one first.
    VideoError
        If a path does not exist or has nothing to search; after all other files, for the first file that is damaged.

    Examples
    --------
    >>> for sighting in find("dahlia.safetensors", "holiday/"):  # doctest: +SKIP
    ...     print(sighting.file, sighting.time, sighting.box, sighting.score)
    """
    search = Search(load_models(_several(models)), RunSettings(skip_damaged=skip_damaged), threshold, every, sizes)
    files = find_files(_several(paths))
    return _sightings(search, files)


def load_models(models: Iterable[str | os.PathLike[str] | Learned]) -> dict[str, Learned]:
    """Load models; returns each by the name of its object, or of its file.

    Raises
    ------
    ServiceError, ProtocolError
        As `Learned.load`.
    SettingsError
        If there is no model, or two have one name.
    """
    named: dict[str, Learned] = {}
    for number, each in enumerate(models, 1):
        learned = each if isinstance(each, Learned) else Learned.load(each)
        name = learned.object or (f"object-{number}" if isinstance(each, Learned) else Path(each).stem)
        if name in named:
            raise SettingsError(f"two models are named {name!r}: rename the file of one, or save it under another name")
        named[name] = learned
    if not named:
        raise SettingsError("a search needs at least one model: `catstream save` and `track --save-model` write one")
    return named


def _digest(learned: Learned) -> str:
    """Identifies what is searched with: weights, bias and size."""
    model = learned.model
    digest = hashlib.sha256(model.weights.tobytes())
    digest.update(np.array([model.bias, *learned.box[2:]]).tobytes())
    return digest.hexdigest()[:16]


def _sightings(search: Search, files: list[File]) -> Iterator[Sighting]:
    problems: list[VideoError] = []
    for file in files:
        unread: list[str] = []
        try:
            for step in search.file(file, damaged=unread.append):
                yield from step.sightings
        except VideoError as error:
            problems.append(error)
        if file.kind != "video":  # of a video, the caller asked to skip them
            problems += map(VideoError, unread)
    if problems:
        raise problems[0]


def _several(given: _One | Iterable[_One]) -> Iterable[_One]:
    """One value or several, as several."""
    return [given] if isinstance(given, str | os.PathLike | Learned) else given


def _scanned(scan: Scan, stretches: Iterator[_Stretch]) -> Generator[tuple[_Stretch, list[list[Seen]]]]:
    """Scan frames in several threads, and yield the results in order; an error of the source comes after them."""
    workers = len(os.sched_getaffinity(0))
    pending: deque[tuple[_Stretch, Future[list[list[Seen]]]]] = deque()
    problem: VideoError | None = None
    with ThreadPoolExecutor(workers, "scan") as pool:
        try:
            for stretch in stretches:
                pending.append((stretch, pool.submit(scan, stretch.frame.image)))
                if len(pending) > workers:
                    first, found = pending.popleft()
                    yield first, found.result()
        except VideoError as error:
            problem = error
        for stretch, found in pending:
            yield stretch, found.result()
    if problem is not None:
        raise problem


def _bisected(
    scan: Scan, before: list[list[Seen]], stretch: _Stretch, after: list[list[Seen]]
) -> list[tuple[Frame, list[list[Seen]]]]:
    """Search frames between two others until it is known where each object appears or disappears.

    Returns
    -------
    the frames that were searched, in order, with what was found in each
    """
    searched: dict[int, list[list[Seen]]] = {}
    for number in range(len(before)):
        if bool(before[number]) == bool(after[number]):
            continue
        low, high = 0, len(stretch.between)  # the first frame that is like `after` is between these, both included
        while low < high:
            middle = (low + high) // 2
            if middle not in searched:
                searched[middle] = scan(stretch.between[middle].image)
            if bool(searched[middle][number]) == bool(before[number]):
                low = middle + 1
            else:
                high = middle
    return [(stretch.between[place], searched[place]) for place in sorted(searched)]
