"""Renders a test video with exact ground truth from two photographs that scikit-learn ships.

A dahlia moves over a picture of a lake while the camera pans. It rotates and
changes its size, the brightness changes, a dahlia of another colour crosses
it, a pagoda occludes it, and it leaves the image and returns elsewhere.
The same arguments give the same pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from numpy import random  # early: numpy's lazy import would lose a Ctrl-C

from catstream.base.box import Box
from catstream.video.writer import VideoWriter

#: Number of different frames, and frames per second.
FRAMES, RATE = 600, 30.0

#: Full size (width, height) of the rendered images in pixels.
SIZE = (640, 480)

_VISIBLE = 0.1  # if a smaller share of the dahlia is visible, it counts as absent
_DAHLIA = (308, 221)  # centre of the dahlia in its photograph, in pixels
_NOISE = 4.0  # standard deviation of the sensor noise, in grey levels
_NOISES = 4096  # different images of noise, one after the other

_ZOOM = 1.5  # enlargement of the photograph of the lake; coordinates below are in the enlarged photograph
_BEHIND = 280  # the last frame in which the dahlia is behind the pagoda

#: Keyframes of the dahlia: frame, centre x and y, diameter, angle in degrees.
_FLIGHT = np.array(
    [
        (0, 800, 190, 104, 0), (60, 700, 300, 120, 25), (110, 610, 330, 112, 60), (160, 560, 250, 96, 110),
        (225, 330, 270, 92, 170), (265, 70, 250, 92, 200), (285, 62, 190, 96, 200), (330, 250, 215, 116, 160),
        (375, 330, 350, 140, 120), (415, 480, 400, 124, 60), (455, 690, 330, 100, 20), (485, 990, 290, 96, 0),
        (520, 990, 420, 100, -40), (550, 790, 430, 108, -60), (600, 640, 250, 120, -120),
    ]
)  # fmt: skip

#: Keyframes of the distractor, the dahlia of another colour.
_DECOY = np.array([(0, 400, 60, 96, 0), (40, 560, 110, 92, 60), (110, 760, 420, 88, 200), (180, 1100, 520, 90, 300)])

#: Keyframes of the camera: frame, left and top of the view, brightness relative to the photograph.
_CAMERA = np.array(
    [
        (0, 316, 20, 1.0), (90, 250, 90, 1.1), (160, 170, 70, 0.75), (240, 10, 30, 1.0), (300, 4, 10, 1.15),
        (380, 60, 110, 0.6), (450, 200, 120, 0.9), (500, 220, 110, 1.0), (600, 300, 60, 0.8),
    ]
)  # fmt: skip

#: Outline of the pagoda in the photograph before enlargement, in pixels.
_PAGODA = np.array(
    [
        (196, 50), (198, 32), (213, 32), (216, 52), (240, 82), (318, 122), (320, 130), (300, 134), (294, 158),
        (328, 172), (329, 182), (320, 190), (320, 226), (326, 240), (352, 250), (340, 266), (342, 300), (350, 312),
        (372, 334), (360, 350), (330, 372), (320, 426), (0, 426), (0, 362), (66, 346), (80, 326), (80, 284), (64, 270),
        (98, 246), (98, 196), (84, 184), (88, 168), (118, 160), (120, 138), (96, 132), (98, 112), (150, 92),
    ]
)  # fmt: skip


def render(frames: int, size: tuple[int, int] = SIZE, seed: int = 0) -> Iterator[tuple[np.ndarray, Box | None]]:
    """Yield the first images of a `Demo` in order, each with the box of the dahlia; see `Demo` for the parameters."""
    yield from map(Demo(size, seed).image, range(frames))


def write(
    folder: Path,
    frames: int = FRAMES,
    size: tuple[int, int] = SIZE,
    done: Callable[[int], None] = lambda _: None,
) -> tuple[Path, list[Box | None]]:
    """Render into a folder: demo.mp4 and groundtruth_rect.txt, as `catstream evaluate` reads them.

    `done` is called with the number of frames written so far. Returns the path of the video, and the box of the object
    in each frame, None if it is absent. Raises VideoError if the folder cannot be written to.
    """
    path, truth = folder / "demo.mp4", []
    with VideoWriter(path, RATE, size) as video:
        for image, box in render(frames, size):
            video.write(image)
            truth.append(box)
            done(len(truth))
    lines = ("nan,nan,nan,nan" if box is None else ",".join(f"{value:.3f}" for value in box) for box in truth)
    (folder / "groundtruth_rect.txt").write_text("\n".join(lines) + "\n", encoding="ascii")
    return path, truth


class Demo:
    """Renders single images from the two photographs.

    After `FRAMES` images the sequence runs backwards, then forwards again, so that a video of any length has no jump.

    If their size is not 4:3, the images are stretched. The seed selects the sensor noise.
    """

    def __init__(self, size: tuple[int, int] = SIZE, seed: int = 0) -> None:
        self.size, lake, rng = size, load_photograph("china"), random.default_rng(seed)
        self.lake = cv2.resize(lake, None, fx=_ZOOM, fy=_ZOOM, interpolation=cv2.INTER_CUBIC).clip(0, 255)
        self.noise = rng.normal(scale=_NOISE, size=(2 * SIZE[1], 2 * SIZE[0], 3)).astype(np.float32)
        self.corners = rng.integers(SIZE[::-1], size=(_NOISES, 2))  # of the part of the noise in each image
        outline = (_PAGODA * _ZOOM).astype(np.int32)
        pagoda = cv2.fillPoly(np.zeros(self.lake.shape[:2], np.float32), [outline], 1.0)
        self.pagoda = cv2.GaussianBlur(pagoda, (0, 0), 1.2)
        self.dahlia = cut_out_dahlia(load_photograph("flower"))
        self.decoy = replace(self.dahlia, colours=self.dahlia.colours[..., [2, 0, 1]] * np.float32(0.9))
        self.flight, self.away, self.camera = (_interpolate(keys) for keys in (_FLIGHT, _DECOY, _CAMERA))

    def image(self, number: int) -> tuple[np.ndarray, Box | None]:
        """An image, uint8 (height, width, 3), blue green red, and the box of the whole dahlia.

        The box includes parts that are occluded or outside the image; it is None if less than a tenth is visible.
        """
        frame = FRAMES - 1 - abs(number % (2 * FRAMES - 2) - (FRAMES - 1))
        left, top, light = self.camera[frame]
        sway = 3 * np.sin(frame / np.array([7.3, 5.1]))  # camera shake
        view = np.array([[1, 0, -left - sway[0]], [0, 1, -top - sway[1]]])  # lake -> picture
        image = cv2.warpAffine(self.lake, view, SIZE, borderMode=cv2.BORDER_REFLECT_101)
        front = cv2.warpAffine(self.pagoda, view, SIZE)

        self.decoy.paint(image, self.decoy.transform(self.away[frame], view), 1 - front)
        transform = self.dahlia.transform(self.flight[frame], view)
        visible = self.dahlia.paint(image, transform, 1 - front if frame <= _BEHIND else np.ones_like(front))
        y, x = self.corners[number % _NOISES]
        noisy = image * np.float32(light) + self.noise[y : y + SIZE[1], x : x + SIZE[0]]
        picture = noisy.clip(0, 255).astype(np.uint8)
        box = self.dahlia.box(transform) if visible >= _VISIBLE else None
        if self.size == SIZE:
            return picture, box
        across, down = self.size[0] / SIZE[0], self.size[1] / SIZE[1]
        box = box and Box(box.x * across, box.y * down, box.w * across, box.h * down)
        return cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA), box


def _interpolate(keys: np.ndarray) -> np.ndarray:
    """Interpolate keyframes to one row for each of `FRAMES` frames, and smooth the changes of direction."""
    bend = np.hanning(27)[1:-1]
    frames = np.arange(FRAMES + len(bend) - 1) - len(bend) // 2
    lines = (np.interp(frames, keys[:, 0], column) for column in keys[:, 1:].T)
    return np.stack([np.convolve(line, bend / bend.sum(), mode="valid") for line in lines], axis=1)


def load_photograph(name: str) -> np.ndarray:
    """Load a photograph that scikit-learn ships as float32 BGR, without its import, which takes seconds."""
    package = find_spec("sklearn")
    if package is None or package.origin is None:
        raise ImportError("scikit-learn is a dependency of catstream and not installed: pip install scikit-learn")
    path = Path(package.origin).parent / "datasets" / "images" / f"{name}.jpg"
    return np.array(cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR), np.float32)


@dataclass(frozen=True, slots=True)
class Sprite:
    """An object that is painted into pictures.

    colours  float32 (s, s, 3), 0 to 255, blue green red
    mask     float32 (s, s), 1 inside the object, 0 outside
    outline  points of the outline, float64 (k, 2), x and y in pixels of the sprite
    """

    colours: np.ndarray
    mask: np.ndarray
    outline: np.ndarray

    def transform(self, pose: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Return the affine map from the sprite to the picture, float64 (2, 3).

        `pose` has x and y of the centre in the scene, the size of the whole sprite in pixels, and the angle in
        degrees; `view` maps the scene to the picture, by a shift.
        """
        (x, y, diameter, angle), side = pose, self.mask.shape[0]
        transform = cv2.getRotationMatrix2D((side / 2, side / 2), angle, diameter / side)
        transform[:, 2] += np.array([x, y]) + view[:, 2] - side / 2
        return transform

    def box(self, transform: np.ndarray) -> Box:
        """Return the box of the whole object in the picture."""
        low, high = self._limits(transform)
        return Box(*map(float, (*low, *(high - low))))

    def paint(self, image: np.ndarray, transform: np.ndarray, free: np.ndarray) -> float:
        """Paint the visible part of the object into an image, float32 (h, w, 3); return its share.

        `free`, float32 (h, w), is 1 for pixels without an occluder.
        """
        height, width = image.shape[:2]
        low, high = self._limits(transform)
        left, top = np.maximum(np.floor(low) - 2, 0).astype(int)
        right, bottom = np.minimum(np.ceil(high) + 2, (width, height)).astype(int)
        if left >= right or top >= bottom:
            return 0.0
        patch, size = image[top:bottom, left:right], (int(right - left), int(bottom - top))
        shift = transform - np.array([[0, 0, left], [0, 0, top]])
        colours = cv2.warpAffine(self.colours, shift, size, borderMode=cv2.BORDER_REPLICATE)
        alpha = cv2.warpAffine(self.mask, shift, size) * free[top:bottom, left:right]
        patch += alpha[..., None] * (colours - patch)
        return float(alpha.sum() / (self.mask.sum() * abs(np.linalg.det(transform[:, :2]))))

    def _limits(self, transform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the top left and bottom right corners of the object in the picture."""
        points = self.outline @ transform[:, :2].T + transform[:, 2]
        return points.min(axis=0), points.max(axis=0)


def cut_out_dahlia(photograph: np.ndarray) -> Sprite:
    """Cut the large flower out of its photograph."""
    (x, y), reach, side = _DAHLIA, 144, 160
    window = slice(y - reach, y + reach), slice(x - reach, x + reach)
    colours = cv2.resize(photograph[window], (side, side), interpolation=cv2.INTER_AREA)
    disc: np.ndarray = cv2.circle(np.zeros((side, side), np.uint8), (side // 2, side // 2), side // 2, 1, cv2.FILLED)
    warm = disc * (colours[..., 2] - colours[..., 0] > 40).astype(np.uint8)
    contours, _ = cv2.findContours(warm, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(contours, key=len)
    filled: np.ndarray = cv2.fillPoly(np.zeros((side, side), np.float32), [outline], 1.0)
    mask = cv2.GaussianBlur(cv2.erode(filled, np.ones((3, 3))), (0, 0), 1.0)
    return Sprite(colours, mask, outline[:, 0].astype(float))
