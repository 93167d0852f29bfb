"""The search of files for the objects of saved models: frames in equal distances of time, and what is seen in them."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from catstream.base.box import Box
from catstream.base.settings import RunSettings
from catstream.base.threads import cores
from catstream.errors import SettingsError, VideoError
from catstream.finding.files import File, NamedFrame, find_files
from catstream.finding.scan import SIZES, THRESHOLD, Match, Scan
from catstream.jobs.saved_model import SavedModel
from catstream.video.frames import Frame

_One = TypeVar("_One", bound=str | os.PathLike[str] | SavedModel)

#: Seconds of a video between two frames that are searched.
EVERY = 0.2


@dataclass(frozen=True, slots=True)
class Detection:
    """An object that was detected in a frame.

    object  name of the object
    file    path of the video, the image, or the folder of images
    frame   number of the frame, or of the image in its folder; the first one is 0
    time    seconds since the start of the video
    box     box of the object in pixels of the frame
    score   about 1 on the object, near 0 elsewhere; at least the threshold of the search
    image   name of the file in a folder of images, otherwise empty
    """

    object: str
    file: str
    frame: int
    time: float
    box: Box
    score: float
    image: str = ""


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
    def digest(self) -> str:
        """A digest of the models and options: two searches with the same digest have the same results."""
        parts = [self.threshold, self.every, *self.sizes, self.settings.image_rate, float(self.settings.skip_damaged)]
        digest = hashlib.sha256(np.array(parts).tobytes())
        for name, saved in self.models.items():
            digest.update(name.encode())
            digest.update(saved.model.weights.tobytes())
            digest.update(np.array([saved.model.bias, *saved.box[2:]]).tobytes())
        return digest.hexdigest()[:16]

    def file(self, file: File, problems: list[str]) -> Iterator[tuple[Frame, list[Detection]]]:
        """Search a file, and yield each frame with its detections. At damage, VideoError follows the frames before."""
        frames = file.frames(self.every, self.settings, problems)
        with closing(frames), closing(_scanned(self._scan, frames)) as scanned:
            for (frame, image), results in scanned:
                place = str(file.path), frame.number, frame.time
                detections = [
                    Detection(name, *place, match.box, match.score, image)
                    for name, matches in zip(self.models, results, strict=True)
                    for match in matches
                ]
                yield frame, detections


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
    search = Search(load_models(_several(models)), RunSettings(skip_damaged=skip_damaged), threshold, every, sizes)
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


def _detections(search: Search, files: list[File]) -> Iterator[Detection]:
    errors: list[VideoError] = []
    for file in files:
        problems: list[str] = []
        try:
            for _, detections in search.file(file, problems):
                yield from detections
        except VideoError as error:
            errors.append(error)
        if file.pages:  # in a video, the caller asked to skip damaged frames
            errors += map(VideoError, problems)
    if errors:
        raise errors[0]


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
