"""Object instance recognition: a model that was learned in one video finds the object in others (paper, section
"Object Instance Recognition").

Each object is learned by tracking it through the first third of its sequence. It is then searched in frames of the rest
of this sequence, and in frames of all other sequences, where every sighting is a false alarm. The first frame alone is
what the other methods know: multi-scale template matching, ORB features with RANSAC, and a model of ours.

In the paper's setting, 76 frames of the object before a plain background are learned, and it is searched before other
backgrounds, in other lights. The paper shows pictures of this, and no figures.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import islice, repeat
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
import shared  # noqa: F401
from sequences import CHECK, painted, sequences
from table import Table, benchmark, command

from catstream.base.box import Box
from catstream.base.threads import one_thread
from catstream.base.workers import SPAWN
from catstream.client.saved_model import SavedModel
from catstream.features.score_map import non_maximum_suppression
from catstream.measure.datasets import Sequence
from catstream.offline.find_scan import Scan
from catstream.tracker import Tracker
from catstream.video.source import open_source

Found = list[tuple[float, Box]]
Finder = Callable[[np.ndarray], Found]

METHODS = ("catstream", "catstream, first frame", "template matching", "ORB and RANSAC")
_LEAST = 0.2  # score of a sighting of ours: low, so that precision is known at every recall
_FACTORS = tuple(1.25**k for k in range(-4, 5))  # sizes at which a template is matched
_TEMPLATE = 48  # longer side of a template in pixels, at most
_MOST = 4  # sightings of one object in a frame
_SAME_VIDEO = 4.0  # grey levels by which the first frames of two sequences of one video differ at most
_PLAIN, _OTHERS = 76, 80  # frames of the paper's setting: learned, and searched with and without the object


@dataclass(frozen=True, slots=True)
class Answer:
    """The sightings in one frame: score, and overlap with the object; `present` if the object is there."""

    present: bool
    sightings: list[tuple[float, float]]


def figures(options: argparse.Namespace) -> Iterator[Table]:
    found = sequences(options)
    answers: dict[str, dict[str, list[Answer]]] = {}
    milliseconds: dict[str, list[float]] = {method: [] for method in METHODS}
    with ProcessPoolExecutor(options.jobs, mp_context=SPAWN) as pool:
        learned = found[:: options.step]
        found_again = (map if options.quick else pool.map)(searched, learned, repeat(options))
        for sequence, (result, spent) in zip(learned, found_again, strict=True):
            answers[sequence.name] = result
            for method in METHODS:
                milliseconds[method].append(spent[method])
            print(sequence.name, file=sys.stderr)
    for title, names in (("all", answers), ("check", [name for name in answers if name in CHECK])):
        if names:
            yield _summary(title, {name: answers[name] for name in names}, milliseconds)
    yield _paper(found, *((8, 4) if options.quick else (_PLAIN, _OTHERS)))
    yield _each(answers)


def searched(sequence: Sequence, options: argparse.Namespace) -> tuple[dict[str, list[Answer]], dict[str, float]]:
    """The answers of each method for the object of a sequence, and its milliseconds a frame."""
    with one_thread(opencv=True):
        finders = finders_of(sequence)
        own = _spread(sequence, len(sequence) // 3, options.own)
        tasks = [(image, box) for image, box in _frames(sequence, own)]
        for other in sequences(options):
            if not _is_same_video(sequence, other):
                tasks += [(image, None) for image, _ in _frames(other, _spread(other, 0, options.others))]
        return _answers(finders, tasks)


def finders_of(sequence: Sequence) -> dict[str, Finder]:
    """The methods, each with what it may know of the object."""
    first = next(iter(sequence.frames()))
    box = Box(*sequence.boxes[0].tolist())
    learned = learn(islice(sequence.frames(), max(2, len(sequence) // 3)), box)
    return dict(zip(METHODS, [ours(learned), ours(learn([first], box)), *others(first, box)], strict=True))


def others(first: np.ndarray, box: Box) -> list[Finder]:
    """The methods that know one image of the object."""
    return [partial(match_template, cut(first, box)), OrbMatcher(cut(first, box))]


def learn(images: Iterator[np.ndarray] | list[np.ndarray], box: Box) -> SavedModel:
    tracker = Tracker()
    for number, image in enumerate(images):
        if number:
            tracker.update(image)
        else:
            tracker.init(image, box)
    return tracker.saved_model()


def ours(learned: SavedModel) -> Finder:
    scan = Scan([learned], _LEAST)
    return lambda image: [(each.score, each.box) for each in scan(image)[0][:_MOST]]


def cut(image: np.ndarray, box: Box) -> np.ndarray:
    height, width = image.shape[:2]
    left, top = min(max(0, int(box.x)), width - 2), min(max(0, int(box.y)), height - 2)
    return image[top : max(top + 2, int(box.y + box.h)), left : max(left + 2, int(box.x + box.w))]


def match_template(template: np.ndarray, image: np.ndarray) -> Found:
    """The places with the highest normalised correlation with a grey template, of any size.

    If the template is large, it and the image are reduced together, which takes less time.
    """
    template, image = (cv2.cvtColor(each, cv2.COLOR_BGR2GRAY) for each in (template, image))
    found: Found = []
    for factor in _FACTORS:
        scale = min(1.0, _TEMPLATE / (factor * max(template.shape)))
        small = image if scale == 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        size = max(4, round(template.shape[1] * factor * scale)), max(4, round(template.shape[0] * factor * scale))
        if size[0] > small.shape[1] or size[1] > small.shape[0]:
            continue
        scores = cv2.matchTemplate(
            small, cv2.resize(template, size, interpolation=cv2.INTER_AREA), cv2.TM_CCOEFF_NORMED
        )
        scores[~np.isfinite(scores)] = -1.0  # a uniform window has no correlation
        for row, column in non_maximum_suppression(scores, _MOST, min(size) // 2):
            found.append((float(scores[row, column]), Box(*(value / scale for value in (column, row, *size)))))
    return _apart(found)


class OrbMatcher:
    """Matches of ORB features that agree on a similarity transform; the score is their number."""

    _SIDE = 120  # of the longer side of the object, to which it is enlarged: ORB finds little in a small image
    _MOST_PIXELS = 4_000_000  # of an enlarged frame

    def __init__(self, template: np.ndarray) -> None:
        self._orb = cv2.ORB_create(nfeatures=1000, edgeThreshold=15, patchSize=31)
        self._scale = max(1.0, self._SIDE / max(template.shape[:2]))
        large = cv2.resize(template, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_CUBIC)
        self._size = large.shape[1], large.shape[0]
        self._points, self._features = self._orb.detectAndCompute(large, None)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)

    def __call__(self, image: np.ndarray) -> Found:
        if self._features is None or len(self._features) < 3:
            return []
        scale = min(self._scale, math.sqrt(self._MOST_PIXELS / (image.shape[0] * image.shape[1])))
        large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        points, features = self._orb.detectAndCompute(large, None)
        if features is None or len(features) < 2:
            return []
        pairs = [pair for pair in self._matcher.knnMatch(self._features, features, k=2) if len(pair) == 2]
        good = [first for first, second in pairs if first.distance < 0.75 * second.distance]
        if len(good) < 3:
            return []
        ours = np.float32([self._points[match.queryIdx].pt for match in good])
        theirs = np.float32([points[match.trainIdx].pt for match in good])
        cv2.setRNGSeed(0)
        matrix, inliers = cv2.estimateAffinePartial2D(ours, theirs, method=cv2.RANSAC, ransacReprojThreshold=5.0)
        if matrix is None:
            return []
        (w, h), corners = self._size, np.array([(0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)])
        placed = corners * (w, h, 1) @ matrix.T / scale
        low, high = placed.min(axis=0), placed.max(axis=0)
        return [(float(inliers.sum()), Box(*map(float, (*low, *np.maximum(high - low, 1e-3)))))]


def _answers(
    finders: dict[str, Finder], tasks: list[tuple[np.ndarray, Box | None]]
) -> tuple[dict[str, list[Answer]], dict[str, float]]:
    result: dict[str, list[Answer]] = {}
    spent: dict[str, float] = {}
    for method, finder in finders.items():
        started = perf_counter()
        found = [finder(image) for image, _ in tasks]
        spent[method] = 1000 * (perf_counter() - started) / len(tasks)
        result[method] = [
            Answer(box is not None, [(score, box.overlap(where) if box else 0.0) for score, where in sightings])
            for sightings, (_, box) in zip(found, tasks, strict=True)
        ]
    return result, spent


def marked(answers: list[Answer]) -> tuple[np.ndarray, np.ndarray, int]:
    """Score of each sighting, whether it is the object (overlap of at least 0.5, once a frame), and frames with it."""
    scores, right = [], []
    for answer in answers:
        hit = False
        for score, overlap in sorted(answer.sightings, reverse=True):
            is_right = answer.present and overlap >= 0.5 and not hit
            hit |= is_right
            scores.append(score)
            right.append(is_right)
    return np.array(scores), np.array(right, bool), sum(answer.present for answer in answers)


def average_precision(answers: list[Answer]) -> float:
    """Mean of the precision at each right sighting, 0 at those that are missing."""
    scores, right, present = marked(answers)
    right = right[np.argsort(-scores, kind="stable")]
    precision = np.cumsum(right) / np.arange(1, len(right) + 1)
    return float((precision * right).sum() / max(present, 1))


def recall_at(answers: list[Answer], rate: float) -> float:
    """Recall in the frames with the object, if `rate` of the frames without it have a false alarm."""
    alarms = [
        max((score for score, _ in answer.sightings), default=-np.inf) for answer in answers if not answer.present
    ]
    wrong = np.sort(alarms)[::-1]
    allowed = int(rate * len(wrong))
    threshold = wrong[allowed] if allowed < len(wrong) else -np.inf
    scores, right, present = marked([answer for answer in answers if answer.present])
    return float((scores[right] > threshold).sum() / max(present, 1))


def _summary(title: str, answers: dict[str, dict[str, list[Answer]]], milliseconds: dict[str, list[float]]) -> Table:
    rows = []
    for method in METHODS:
        pooled = [answer for each in answers.values() for answer in each[method]]
        precision = float(np.mean([average_precision(each[method]) for each in answers.values()]))
        rows.append(
            (method, precision, recall_at(pooled, 0.01), recall_at(pooled, 0.001), float(np.mean(milliseconds[method])))
        )
    present = sum(answer.present for answer in pooled)
    note = f"{len(answers)} objects; {present} frames with the object, {len(pooled) - present} without; one core"
    columns = ("method", "mean AP", "recall at 1 false alarm in 100", "in 1,000 frames", "ms a frame")
    return Table(f"Found again: {title} sequences", columns, rows, note)


def _each(answers: dict[str, dict[str, list[Answer]]]) -> Table:
    rows = [(name, *(average_precision(each[method]) for method in METHODS)) for name, each in answers.items()]
    return Table("Average precision of each object", ("object", *METHODS), rows)


def _paper(found: list[Sequence], learning: int, searched: int) -> Table:
    """SavedModel before a plain background, searched before others and in other lights."""
    rng = np.random.default_rng(0)
    plain = np.full((240, 320, 3), 190, np.uint8)
    shown = [_shown(plain, rng, 20, (0.9, 1.1), (0.95, 1.05), centre) for centre in _path(learning)]
    backgrounds = [
        cv2.resize(next(iter(sequence.since(len(sequence) // 2).frames())), (320, 240)) for sequence in found
    ]
    tasks: list[tuple[np.ndarray, Box | None]] = []
    for number in range(searched):
        background = backgrounds[number % len(backgrounds)]
        tasks.append((background, None))
        tasks.append(_shown(background, rng, 40, (0.6, 1.6), (0.5, 1.4)))
    learned = learn([each for each, _ in shown], shown[0][1])
    first = learn([shown[0][0]], shown[0][1])
    finders = dict(zip(METHODS, [ours(learned), ours(first), *others(*shown[0])], strict=True))
    result, _ = _answers(finders, tasks)
    rows = [
        (name, average_precision(each), recall_at(each, 0.01), recall_at(each, 0.0)) for name, each in result.items()
    ]
    columns = ("method", "AP", "recall at 1 false alarm in 100 frames", "without a false alarm")
    note = f"{learning} frames before a plain background; {searched} frames with and {searched} without the object"
    return Table("The paper's setting, rendered", columns, rows, note)


def _path(frames: int) -> list[tuple[float, float]]:
    """Centres of the object while it is learned."""
    turns = np.linspace(0, 2 * np.pi, frames)
    return [(160 + 60 * np.sin(turn), 120 + 40 * np.sin(2 * turn)) for turn in turns.tolist()]


def _shown(
    background: np.ndarray,
    rng: np.random.Generator,
    degrees: float,
    sizes: tuple[float, float],
    lights: tuple[float, float],
    centre: tuple[float, float] | None = None,
) -> tuple[np.ndarray, Box]:
    """A background with the object, turned and scaled, and all of it in another light."""
    height, width = background.shape[:2]
    side = 64 * float(np.exp(rng.uniform(*np.log(sizes))))
    x, y = centre or (rng.uniform(side / 2, width - side / 2), rng.uniform(side / 2, height - side / 2))
    return painted(background, (x, y, side, float(rng.uniform(-degrees, degrees))), rng.uniform(*lights), rng)


def _apart(found: Found) -> Found:
    """The best sightings that overlap no better one."""
    kept: Found = []
    for score, box in sorted(found, key=lambda each: -each[0]):
        if len(kept) < _MOST and all(box.overlap(other) < 0.3 for _, other in kept):
            kept.append((score, box))
    return kept


def _spread(sequence: Sequence, begin: int, count: int) -> slice:
    """`count` frames of a sequence at equal distances, from `begin` on."""
    return slice(begin, len(sequence), math.ceil((len(sequence) - begin) / count))


def _frames(sequence: Sequence, part: slice) -> list[tuple[np.ndarray, Box | None]]:
    """Some frames of a sequence, and the box of the object in each."""
    boxes = [Box(*box) for box in sequence.boxes[part].tolist()]
    shown = (box if np.isfinite(box).all() else None for box in boxes)
    return list(zip(_images(sequence.path, sequence.begin, part.start, part.stop, part.step), shown, strict=True))


@lru_cache(maxsize=128)
def _images(path: Path, first: int, start: int, stop: int, step: int) -> list[np.ndarray]:
    with open_source(path, part=slice(first + start, first + stop, step)) as source:
        return [frame.image for frame in source]


def _is_same_video(one: Sequence, other: Sequence) -> bool:
    """Return True if two sequences are of one video: then the object of one is in the other."""
    first, second = (_frames(each, slice(0, 1, 1))[0][0] for each in (one, other))
    return first.shape == second.shape and float(cv2.absdiff(first, second).mean()) < _SAME_VIDEO


if __name__ == "__main__":
    benchmark(
        figures,
        command(__doc__),
        own=(12, "frames of the rest of each sequence"),
        others=(2, "frames of each other sequence"),
        step=(1, "learn only every N-th sequence"),
        jobs=(os.cpu_count() or 1, "number of processes"),
    )
