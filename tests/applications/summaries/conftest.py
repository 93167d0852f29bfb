"""Real images for the tests of summaries: parts of two photographs."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from catstream.applications.summaries.images import describe


@pytest.fixture(scope="session")
def photographs() -> list[np.ndarray]:
    """120 parts of scikit-learn's two photographs, of different places and sizes."""
    from sklearn.datasets import load_sample_image

    rng = np.random.default_rng(3)
    parts = []
    for number in range(120):
        image = load_sample_image(("china.jpg", "flower.jpg")[number % 2])[:, :, ::-1]
        side = int(rng.integers(80, 300))
        y, x = rng.integers(0, [image.shape[0] - side, image.shape[1] - side])
        parts.append(np.ascontiguousarray(image[y : y + side, x : x + side * 2]))
    return parts


@pytest.fixture(scope="session")
def rows(photographs: list[np.ndarray]) -> np.ndarray:
    """Their feature rows, float32 (120, d)."""
    return np.array([describe(image) for image in photographs])


@pytest.fixture
def folder(photographs: list[np.ndarray], tmp_path):
    """A folder of twelve images in two subfolders, one damaged and one hidden, and a file that is no image."""
    for number, image in enumerate(photographs[:12]):
        file = tmp_path / "photos" / ("a" if number < 6 else "b") / f"{number}.jpg"
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), image)
    (tmp_path / "photos" / "a" / "4.jpg").write_bytes(b"\xff\xd8\xff damaged")
    (tmp_path / "photos" / ".hidden.jpg").write_bytes(b"")
    (tmp_path / "photos" / "notes.txt").write_text("no image")
    return tmp_path / "photos"
