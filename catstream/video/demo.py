"""Renders a test video with exact ground truth from two photographs that scikit-learn ships.

A dahlia moves over a picture of a lake while the camera pans. It rotates and
changes its size, the brightness changes, a dahlia of another colour crosses
it, a pagoda occludes it, and it leaves the image and returns at another place.
The same arguments give the same pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from catstream.box import Box
from catstream.messages.names import UNNAMED
from catstream.video.sprite import SIZE, VISIBLE, Lake, cut_out_dahlia, load_photograph, resized
from catstream.video.writer import VideoWriter

#: Number of different frames, and frames per second.
FRAMES, RATE = 600, 30.0

_ZOOM = 1.5  # enlargement of the photograph of the lake; coordinates below are in the enlarged photograph
_BEHIND = 280  # the last frame in which the dahlia is behind the pagoda

#: Key frames of the dahlia: frame, centre x and y, diameter, angle in degrees.
_FLIGHT = np.array(
    [
        (0, 800, 190, 104, 0),
        (60, 700, 300, 120, 25),
        (110, 610, 330, 112, 60),
        (160, 560, 250, 96, 110),
        (225, 330, 270, 92, 170),
        (265, 70, 250, 92, 200),
        (285, 62, 190, 96, 200),
        (330, 250, 215, 116, 160),
        (375, 330, 350, 140, 120),
        (415, 480, 400, 124, 60),
        (455, 690, 330, 100, 20),
        (485, 990, 290, 96, 0),
        (520, 990, 420, 100, -40),
        (550, 790, 430, 108, -60),
        (600, 640, 250, 120, -120),
    ]
)

#: Key frames of the distractor, the dahlia of another colour.
_DECOY = np.array([(0, 400, 60, 96, 0), (40, 560, 110, 92, 60), (110, 760, 420, 88, 200), (180, 1100, 520, 90, 300)])

#: Key frames of the camera: frame, left and top of the view, brightness relative to the photograph.
_CAMERA = np.array(
    [
        (0, 316, 20, 1.0),
        (90, 250, 90, 1.1),
        (160, 170, 70, 0.75),
        (240, 10, 30, 1.0),
        (300, 4, 10, 1.15),
        (380, 60, 110, 0.6),
        (450, 200, 120, 0.9),
        (500, 220, 110, 1.0),
        (600, 300, 60, 0.8),
    ]
)

#: Outline of the pagoda in the photograph before enlargement, in pixels.
_PAGODA = np.array(
    [
        (196, 50), (198, 32), (213, 32), (216, 52), (240, 82), (318, 122), (320, 130), (300, 134), (294, 158),
        (328, 172), (329, 182), (320, 190), (320, 226), (326, 240), (352, 250), (340, 266), (342, 300), (350, 312),
        (372, 334), (360, 350), (330, 372), (320, 426), (0, 426), (0, 362), (66, 346), (80, 326), (80, 284), (64, 270),
        (98, 246), (98, 196), (84, 184), (88, 168), (118, 160), (120, 138), (96, 132), (98, 112), (150, 92),
    ]
)  # fmt: skip


def render(
    frames: int = FRAMES, size: tuple[int, int] = SIZE, seed: int = 0, *, begin: int = 0
) -> Iterator[tuple[np.ndarray, Box | None]]:
    """Yield the first images of a `Demo` in order, each with the box of the dahlia; the parameters are those of it."""
    yield from map(Demo(size, seed, begin=begin).image, range(frames))


def write(
    folder: Path,
    frames: int = FRAMES,
    size: tuple[int, int] = SIZE,
    done: Callable[[int], None] = lambda _: None,
) -> tuple[Path, list[Box | None]]:
    """Render into a folder: demo.mp4 and groundtruth_rect.txt, as `catstream evaluate` reads them.

    Parameters
    ----------
    folder : folder to write to; it is made if it does not exist
    frames, size : as in `render`
    done : function that is called with the number of frames written so far

    Returns
    -------
    path of the video, and the box of the object in each frame, None if it is absent

    Raises
    ------
    VideoError
        If the folder cannot be written to.
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

    Parameters
    ----------
    size : (width, height) of the images; if it is not 4:3, the images are stretched
    seed : seed of the sensor noise
    begin : number in the sequence of image 0
    """

    def __init__(self, size: tuple[int, int] = SIZE, seed: int = 0, *, begin: int = 0) -> None:
        self.size, self.begin = size, begin
        self.lake = Lake(_ZOOM, np.random.default_rng(seed))
        shape = self.lake.picture.shape[:2]
        pagoda = cv2.fillPoly(np.zeros(shape, np.float32), [(_PAGODA * _ZOOM).astype(np.int32)], 1.0)
        self.pagoda = cv2.GaussianBlur(pagoda, (0, 0), 1.2)
        self.dahlia = cut_out_dahlia(load_photograph("flower"))
        self.decoy = replace(self.dahlia, colours=self.dahlia.colours[..., [2, 0, 1]] * np.float32(0.9))
        self.flight, self.away, self.camera = (_interpolate(keys) for keys in (_FLIGHT, _DECOY, _CAMERA))

    def image(self, number: int) -> tuple[np.ndarray, Box | None]:
        """Return an image, and the box of the dahlia.

        Returns
        -------
        image : uint8 (height, width, 3), blue green red
        box : box of the whole dahlia, including parts that are occluded or outside the image; None if less than a tenth
            of it is visible
        """
        frame = FRAMES - 1 - abs((self.begin + number) % (2 * FRAMES - 2) - (FRAMES - 1))
        left, top, light = self.camera[frame]
        sway = 3 * np.sin(frame / np.array([7.3, 5.1]))  # camera shake
        view = np.array([[1, 0, -left - sway[0]], [0, 1, -top - sway[1]]])  # lake -> picture
        image, front = self.lake.seen(view), cv2.warpAffine(self.pagoda, view, SIZE)

        self.decoy.paint(image, self.decoy.turned(self.away[frame], view), 1 - front)
        turn = self.dahlia.turned(self.flight[frame], view)
        seen = self.dahlia.paint(image, turn, 1 - front if frame <= _BEHIND else np.ones_like(front))
        box = self.dahlia.box(turn) if seen >= VISIBLE else None
        shown, boxes = resized(self.lake.with_noise(image * np.float32(light), number), {UNNAMED: box}, self.size)
        return shown, boxes[UNNAMED]


def _interpolate(keys: np.ndarray) -> np.ndarray:
    """Interpolate key frames to one row for each of `FRAMES` frames, and smooth the changes of direction."""
    bend = np.hanning(27)[1:-1]
    frames = np.arange(FRAMES + len(bend) - 1) - len(bend) // 2
    lines = (np.interp(frames, keys[:, 0], column) for column in keys[:, 1:].T)
    return np.stack([np.convolve(line, bend / bend.sum(), mode="valid") for line in lines], axis=1)
