"""An object that was learned at some cameras is searched for at another one, with the models of one, of some, of all.

A long sequence is cut into four parts of equal length, as if each was a camera: what was learned in the first frames of
each of the first three is searched for in the last one. In the rendered scenes, an object moves before four backgrounds
in four lights. The models are merged as in a fleet; `one tree` has seen the features of all three cameras.

`recall` is the share of frames with the object in which the reported box overlaps the true one by half. `wrong` is the
share of frames in which another box is reported, and `stranger` the share in which a box is reported at a camera that
the object does not come to: another sequence, or a fifth background.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import cv2
import numpy as np

sys.path.append(str(Path(__file__).parents[1]))  # shared modules of the benchmarks

from learning import each, features, hits, learning_command, model_of, tracked
from sequences import CHECK, painted, rendered, scratch, sequences
from table import Table, mean_and_error, publish

from catstream.base.settings import Settings
from catstream.evaluation.datasets import Sequence, find_sequences
from catstream.jobs.saved_model import SavedModel, merge
from catstream.video.writer import VideoWriter

_CAMERAS = 4
_LONG = 500  # frames of a sequence that is cut
_SIZE = (320, 240)
_FIGURES = ("recall", "wrong", "stranger")


class Camera(NamedTuple):
    """The frames of a camera: those of a sequence from `start` on."""

    sequence: Sequence
    start: int


class Scene(NamedTuple):
    """An object at several cameras, the last of which searches for it, and a camera that it does not come to."""

    name: str
    cameras: list[Camera]
    stranger: Camera


#: Of each model: recall, share of wrong boxes, share of boxes where the object is not.
Row = dict[str, tuple[float, float, float]]


def measured(task: tuple[Scene, int, int]) -> tuple[str, Row]:
    """Measure the models of a scene."""
    scene, learning, frames = task
    *cameras, last = scene.cameras
    settings = Settings()
    found = [features(camera.sequence, camera.start, learning, settings) for camera in cameras]
    models = [model_of(one, settings) for one in found]
    counts = range(2, len(models) + 1)
    searched = {"camera 1": models[0]}
    searched |= {f"cameras 1-{count}": merge(models[:count], force=True) for count in counts}
    searched["one tree"] = model_of([part for one in found for part in one], settings)
    return scene.name, {name: _searched(learned, last, scene.stranger, frames) for name, learned in searched.items()}


def _searched(learned: SavedModel, last: Camera, stranger: Camera, frames: int) -> tuple[float, float, float]:
    """Search with one model."""
    tracks = tracked(learned, last.sequence, last.start, frames)
    right = hits(tracks, last.sequence, last.start)
    wrong = sum(track.box is not None for track in tracks) - sum(right)
    others = tracked(learned, stranger.sequence, stranger.start, frames)
    return fmean(right), wrong / len(tracks), fmean(track.box is not None for track in others)


def cut(found: list[Sequence], learning: int) -> Iterator[Scene]:
    """Cut sequences into cameras, each at the first frame of its part with the object."""
    for sequence, other in zip(found, found[1:] + found[:1], strict=True):
        length = len(sequence) // _CAMERAS
        present = np.isfinite(sequence.boxes).all(axis=1)
        starts = [number * length + int(present[number * length :].argmax()) for number in range(_CAMERAS)]
        if all(present[start : start + learning].all() for start in starts):
            yield Scene(sequence.name, [Camera(sequence, start) for start in starts], Camera(other, 0))


def before_backgrounds(found: list[Sequence], scenes: int, frames: int) -> Iterator[Scene]:
    """Render an object before backgrounds from sequences, at cameras in different lights."""
    rng = np.random.default_rng(0)
    for scene in range(scenes):
        cameras = []
        for number in range(_CAMERAS + 1):
            other = found[(scene * (_CAMERAS + 1) + number) % len(found)]
            image = next(iter(other.frames(0)))
            background = cv2.resize(image, _SIZE).astype(np.float32)
            folder = scratch() / f"painted-{scene}-{number}"
            _paint(folder, background, frames, rng, empty=number == _CAMERAS)
            cameras.append(Camera(find_sequences(folder)[0], 0))
        yield Scene(f"rendered {scene + 1}", cameras[:-1], cameras[-1])


def _paint(folder: Path, background: np.ndarray, frames: int, rng: np.random.Generator, *, empty: bool) -> None:
    """Write the video of a camera and its ground truth."""
    folder.mkdir()
    light, size, phase = rng.uniform(0.6, 1.3), rng.uniform(50, 90), rng.uniform(0, 2 * np.pi)
    lines = []
    with VideoWriter(folder / "camera.mp4", 25.0, _SIZE) as video:
        for frame in range(frames):
            turn = phase + 0.08 * frame
            place = (160 + 80 * np.sin(turn), 120 + 50 * np.sin(2 * turn), size, np.degrees(0.3 * turn))
            image, box = painted(background, place, light, rng, empty=empty)
            video.write(image)
            lines.append(",".join(f"{side:.3f}" for side in box))
    (folder / "groundtruth_rect.txt").write_text("\n".join(lines) + "\n", encoding="ascii")


def figures(options: argparse.Namespace) -> Iterator[Table]:
    learning, frames = (12, 4) if options.quick else (options.learning, options.frames)
    if options.quick:
        backgrounds = [rendered(4 * learning + frames, _SIZE)]
        scenes = [*before_backgrounds(backgrounds, 1, learning)]
    else:
        found = [sequence for sequence in sequences(options) if (sequence.name in CHECK) == options.check]
        long = [sequence for sequence in found if len(sequence) >= _LONG]
        scenes = [*cut(long, learning), *before_backgrounds(found, options.scenes, max(learning, frames))]
    rows = [*each(options, measured, [(scene, learning, frames) for scene in scenes])]
    names = list(rows[0][1])
    columns = ("scene", *(f"{name}: {figure}" for name in names for figure in _FIGURES))
    cells = [(scene, *(value for name in names for value in row[name])) for scene, row in rows]
    yield Table("Each scene", columns, cells, f"{learning} frames learned at each camera, {frames} frames searched")
    kinds = {"sequences": [row for scene, row in rows if not scene.startswith("rendered")]}
    kinds["rendered"] = [row for scene, row in rows if scene.startswith("rendered")]
    heads = ("model", *(text for figure in _FIGURES for text in (figure, "± s.e.")))
    for kind, chosen in kinds.items():
        if chosen:
            yield Table(f"Found at another camera: {kind}", heads, [*_summary(names, chosen)], f"{len(chosen)} scenes")


def _summary(names: list[str], rows: list[Row]) -> Iterator[tuple]:
    """The mean of each model, and the mean of the differences to the model of all cameras, with standard errors."""
    for name in names:
        yield name, *_means([row[name] for row in rows])
    merged = names[-2]
    for name in (names[0], names[-1]):
        differences = [tuple(a - b for a, b in zip(row[merged], row[name], strict=True)) for row in rows]
        yield f"{merged} less {name}", *_means(differences)


def _means(rows: list[tuple[float, ...]]) -> list[float]:
    return [cell or 0.0 for column in zip(*rows, strict=True) for cell in mean_and_error(column)]


if __name__ == "__main__":
    parser = learning_command(__doc__)
    parser.add_argument("--learning", type=int, default=60, help="frames learned at each camera (default: %(default)s)")
    parser.add_argument("--scenes", type=int, default=8, help="rendered scenes (default: %(default)s)")
    options = parser.parse_args()
    publish(figures(options), options)
