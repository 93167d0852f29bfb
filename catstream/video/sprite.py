"""What the rendered videos share: sprites and the lake, from the two photographs that scikit-learn ships.

A sprite is a textured object with a soft outline that moves over the photograph of the lake.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from catstream.box import Box

#: Full size (width, height) of the rendered images in pixels.
SIZE = (640, 480)

#: If a smaller share of a sprite is visible, its object counts as absent.
VISIBLE = 0.1

_DAHLIA = (308, 221)  # centre of the dahlia in its photograph, in pixels
_NOISE = 4.0  # standard deviation of the sensor noise, in grey levels
_NOISES = 4096  # different images of noise, one after the other


def load_photograph(name: str) -> np.ndarray:
    """Load a photograph that scikit-learn ships as float32 BGR.

    The file is read without an import of scikit-learn, which takes seconds and whose own loader needs Pillow.
    """
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

    def turned(self, place: np.ndarray, view: np.ndarray) -> np.ndarray:
        """Return the affine map from the sprite to the picture, float64 (2, 3).

        Parameters
        ----------
        place : x and y of the centre in the scene, size of the whole sprite in pixels, angle in degrees
        view : map from the scene to the picture, a shift
        """
        (x, y, diameter, angle), side = place, self.mask.shape[0]
        turn = cv2.getRotationMatrix2D((side / 2, side / 2), angle, diameter / side)
        turn[:, 2] += np.array([x, y]) + view[:, 2] - side / 2
        return turn

    def box(self, turn: np.ndarray) -> Box:
        """Return the box of the whole object in the picture."""
        low, high = self._limits(turn)
        return Box(*map(float, (*low, *(high - low))))

    def paint(self, image: np.ndarray, turn: np.ndarray, free: np.ndarray) -> float:
        """Paint the unoccluded part of the object; return the visible share of the object.

        Parameters
        ----------
        image : float32 (h, w, 3), is changed
        free : float32 (h, w), 1 for pixels in which nothing occludes the object
        """
        height, width = image.shape[:2]
        low, high = self._limits(turn)
        left, top = np.maximum(np.floor(low) - 2, 0).astype(int)
        right, bottom = np.minimum(np.ceil(high) + 2, (width, height)).astype(int)
        if left >= right or top >= bottom:
            return 0.0
        patch, size = image[top:bottom, left:right], (int(right - left), int(bottom - top))
        shift = turn - np.array([[0, 0, left], [0, 0, top]])
        colours = cv2.warpAffine(self.colours, shift, size, borderMode=cv2.BORDER_REPLICATE)
        alpha = cv2.warpAffine(self.mask, shift, size) * free[top:bottom, left:right]
        patch += alpha[..., None] * (colours - patch)
        return float(alpha.sum() / (self.mask.sum() * abs(np.linalg.det(turn[:, :2]))))

    def _limits(self, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the top left and bottom right corners of the object in the picture."""
        points = self.outline @ turn[:, :2].T + turn[:, 2]
        return points.min(axis=0), points.max(axis=0)


class Lake:
    """The picture of the lake over which sprites move, and the sensor noise of the camera.

    Parameters
    ----------
    zoom : enlargement of the photograph
    rng : random numbers of the noise
    """

    def __init__(self, zoom: float, rng: np.random.Generator) -> None:
        photograph = load_photograph("china")
        self.picture = cv2.resize(photograph, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC).clip(0, 255)
        self._noise = rng.normal(scale=_NOISE, size=(2 * SIZE[1], 2 * SIZE[0], 3)).astype(np.float32)
        self._corners = rng.integers(SIZE[::-1], size=(_NOISES, 2))

    def seen(self, view: np.ndarray) -> np.ndarray:
        """Return the part of it that the camera sees, float32 (h, w, 3), 0 to 255; `view` maps it to the image."""
        return cv2.warpAffine(self.picture, view, SIZE, borderMode=cv2.BORDER_REFLECT_101)

    def with_noise(self, image: np.ndarray, number: int) -> np.ndarray:
        """Return an image with the noise of a number, uint8."""
        y, x = self._corners[number % _NOISES]
        return (image + self._noise[y : y + SIZE[1], x : x + SIZE[0]]).clip(0, 255).astype(np.uint8)


def resized(
    image: np.ndarray, boxes: Mapping[str, Box | None], size: tuple[int, int]
) -> tuple[np.ndarray, dict[str, Box | None]]:
    """Return an image of full size and its boxes in another size; if it is not 4:3, they are stretched."""
    if size == SIZE:
        return image, dict(boxes)
    x, y = size[0] / SIZE[0], size[1] / SIZE[1]
    scaled = {name: box and Box(box.x * x, box.y * y, box.w * x, box.h * y) for name, box in boxes.items()}
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA), scaled


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
