"""Renders a video of several objects with exact ground truth, from two photographs that scikit-learn ships.

Dahlias of several colours and pieces of the photographs move over a picture of a lake while the camera pans. They turn,
change their size, cross and occlude one another, and some of them leave the picture and come back. Objects 1 and 5,
2 and 6 ... look alike. The same arguments give the same pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from catstream.base.box import Box
from catstream.video.rendered import SIZE, VISIBLE, Lake, Sprite, cut_out_dahlia, load_photograph, resized

#: Names of the objects, in the order in which they are painted: a later one is in front.
NAMES = (
    *("anna", "ben", "carla", "dan", "eva", "finn", "gina", "hugo"),
    *("ida", "jan", "kim", "lea", "max", "nora", "oskar", "pia"),
)

_COLUMNS = 4  # objects start in a grid
_ZOOM = 1.7  # enlargement of the photograph of the lake
_ALIKE = 25.0  # difference of the hue of objects that look alike, in degrees
_SIDE = 160  # of a sprite, in pixels
_OUTSIDE = (0.45, 0.65)  # part of the video in which every third object leaves the picture
_PIECES = ((160, 150), (500, 320))  # corners of pieces of the photograph of the lake: the pagoda, trees


def render(
    count: int, frames: int, size: tuple[int, int] = SIZE, seed: int = 0
) -> Iterator[tuple[np.ndarray, dict[str, Box | None]]]:
    """Yield images of `count` objects, 1 to 16, uint8 (height, width, 3), each with the box of every object by name.

    A box is that of the whole object, including parts that are occluded or outside the image; it is None if less than a
    tenth of the object is visible. If `size`, (width, height), is not 4:3, the images are stretched; the seed is that
    of paths and sensor noise.
    """
    rng = np.random.default_rng(seed)
    photograph, dahlia = load_photograph("china"), cut_out_dahlia(load_photograph("flower"))
    sprites = [_sprite(number, photograph, dahlia) for number in range(count)]
    paths = [_path(number, count, frames, rng) for number in range(count)]
    lake = Lake(_ZOOM, rng)
    view = np.array([[1.0, 0, 0], [0, 1, 0]])  # the paths are in the picture, not in the scene
    for frame in range(frames):
        turn = 2 * np.pi * frame / 240
        left, top = 150 + 90 * np.sin(turn), 90 + 60 * np.sin(1.3 * turn)
        image, free = lake.crop(np.array([[1, 0, -left], [0, 1, -top]])), np.ones(SIZE[::-1], np.float32)
        boxes: dict[str, Box | None] = {}
        for name, sprite, path in reversed(list(zip(NAMES, sprites, paths, strict=False))):
            place = sprite.transform(path[frame], view)
            visible = sprite.paint(image, place, free)
            free *= 1 - cv2.warpAffine(sprite.mask, place, SIZE)
            boxes[name] = sprite.box(place) if visible >= VISIBLE else None
        yield resized(lake.with_noise(image, frame), dict(reversed(boxes.items())), size)


def _sprite(number: int, lake: np.ndarray, dahlia: Sprite) -> Sprite:
    """The sprite of an object: a dahlia of its own colour, or an oval piece of the photograph of the lake."""
    kind, copy = number % _COLUMNS, number // _COLUMNS
    if kind % 2 == 0:
        return replace(dahlia, colours=_rotated_hue(dahlia.colours, 75.0 * kind + _ALIKE * copy))
    x, y = _PIECES[kind // 2]
    colours = cv2.resize(lake[y : y + 100, x : x + 100], (_SIDE, _SIDE), interpolation=cv2.INTER_CUBIC).clip(0, 255)
    colours = _rotated_hue(colours, 150.0 + 2 * _ALIKE * copy)
    axes = (_SIDE * 30 // 100, _SIDE * 47 // 100) if kind == 1 else (_SIDE * 47 // 100, _SIDE * 33 // 100)
    outline = np.array(cv2.ellipse2Poly((_SIDE // 2, _SIDE // 2), axes, 0, 0, 360, 4), float)
    filled = cv2.fillPoly(np.zeros((_SIDE, _SIDE), np.float32), [outline.astype(np.int32)], 1.0)
    return Sprite(colours, cv2.GaussianBlur(filled, (0, 0), 1.0), outline)


def _path(number: int, count: int, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Centre, size and angle of an object in each frame, float64 (frames, 4): it swings around a place in the grid."""
    rows = -(-count // _COLUMNS)
    column, row = number % _COLUMNS, number // _COLUMNS
    x, y = SIZE[0] * (column + 0.5) / _COLUMNS, SIZE[1] * (row + 0.5) / rows
    time = np.arange(frames)
    wide, high, slow, fast = rng.uniform((110, 60, 190, 120), (190, 150, 260, 180))
    toward = 1 if (column + row) % 2 else -1
    path = np.empty((frames, 4))
    path[:, 0] = x + toward * wide * np.sin(2 * np.pi * time / slow)
    path[:, 1] = y + high * np.sin(2 * np.pi * time / fast) * (1 if y < SIZE[1] / 2 else -1)
    size = min(104.0, 0.8 * SIZE[0] / _COLUMNS, 0.8 * SIZE[1] / rows)
    path[:, 2] = size * (1 + 0.15 * np.sin(2 * np.pi * time / rng.uniform(150, 250)))
    path[:, 3] = rng.uniform(15, 40) * np.sin(2 * np.pi * time / rng.uniform(120, 220))
    margin = size / 2
    path[:, :2] = path[:, :2].clip(margin, np.array(SIZE) - margin)
    if number % 3 == 2:  # it leaves through the nearer side, and comes back
        begin, end = (share * frames for share in _OUTSIDE)
        away = np.clip(np.minimum(time - begin, end - time) / min(15, (end - begin) / 4), 0, 1)
        path[:, 0] += away * ((SIZE[0] + size if x > SIZE[0] / 2 else -size) - path[:, 0])
    return path


def _rotated_hue(colours: np.ndarray, degrees: float) -> np.ndarray:
    """Colours with another hue, float32 0 to 255."""
    hsv = cv2.cvtColor((colours / 255).astype(np.float32), cv2.COLOR_BGR2HSV)
    hsv[..., 0] = (hsv[..., 0] + degrees) % 360
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR) * np.float32(255), np.float32)
