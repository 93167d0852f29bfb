"""The search of files for the objects of saved models, in frames at regular intervals."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from catstream.base.box import Box
from catstream.base.threads import cores
from catstream.client.saved_model import SavedModel
from catstream.errors import SettingsError, VideoError
from catstream.offline.find_files import File, NamedFrame, find_files
from catstream.offline.find_scan import THRESHOLD, Match, Scan
from catstream.video.frames import Frame

#: Interval between two searched frames of a video, in seconds.
EVERY = 0.2


@dataclass(frozen=True, slots=True)
class Detection:
    """A detection of an object in a frame.

    object  name of the object
    file    path of the video, the image, or the folder of images
    frame   number of the frame, or of the image in its folder, from 0
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
    """Searches files for the objects of several models, with a thread for each core.

    models     models by the name of the object
    threshold  minimum score of a detection
    every      interval between two searched frames of a video in seconds, 0 for every frame
    """

    models: Mapping[str, SavedModel]
    threshold: float = THRESHOLD
    every: float = EVERY
    _scan: Scan = field(init=False)

    def __post_init__(self) -> None:
        self._scan = Scan(self.models.values(), self.threshold)

    @property
    def digest(self) -> str:
        """A digest of the models and options: two searches with the same digest have the same results."""
        models = [(name, saved.model.weights.tobytes(), saved.box) for name, saved in self.models.items()]
        return hashlib.sha256(repr((models, self.threshold, self.every)).encode()).hexdigest()[:16]

    def file(self, file: File, problems: list[str]) -> Iterator[tuple[Frame, list[Detection]]]:
        """Yield each searched frame of a file with its detections; problems and errors are as in `File.frames`."""
        frames = file.frames(self.every, problems)
        with closing(frames), closing(_scanned(self._scan, frames)) as scanned:
            for (frame, image), results in scanned:
                position = str(file.path), frame.number, frame.time
                detections = [
                    Detection(name, *position, match.box, match.score, image)
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
) -> Iterator[Detection]:
    """Find the objects of saved models in videos, folders and images.

    Parameters
    ----------
    models : path or SavedModel, or iterable of them
        An object without a name is named after its file.
    paths : path, or iterable of paths
        Videos, images, and folders, which are searched with their subfolders.
    threshold : float
        Minimum score of a detection; the score is about 1 on the object.
    every : float
        Interval between two searched frames of a video in seconds, 0 for every frame.

    Yields
    ------
    Detection
        Files in the order of `paths`, frames in order, objects in the order of `models`, highest score first.

    Raises
    ------
    ServiceError, ProtocolError
        If a model does not exist, is damaged, or has other features.
    SettingsError
        If two models have the same name.
    VideoError
        If a path does not exist or has nothing to search; after all files, if one was damaged.

    Examples
    --------
    >>> for detection in find("dahlia.safetensors", "holiday/"):  # doctest: +SKIP
    ...     print(detection.file, detection.time, detection.box, detection.score)
    """
    models = [models] if isinstance(models, str | os.PathLike | SavedModel) else models
    paths = [paths] if isinstance(paths, str | os.PathLike) else paths
    return _detections(Search(load_models(models), threshold, every), find_files(paths))


def load_models(models: Iterable[str | os.PathLike[str] | SavedModel]) -> dict[str, SavedModel]:
    """Load models; returns them by the name of their object or file."""
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
    problems: list[str] = []
    for file in files:
        try:
            for _, detections in search.file(file, problems):
                yield from detections
        except VideoError as error:
            problems.append(str(error))
    if problems:
        raise VideoError(problems[0])


def _scanned(scan: Scan, frames: Iterator[NamedFrame]) -> Generator[tuple[NamedFrame, list[list[Match]]]]:
    """Scan frames in several threads, and yield the results in order; an error of the source is raised at the end."""
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
