"""A short sequence with truth, cut from the demo video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from catstream.applications.evaluation.datasets import Sequence, find_sequences
from catstream.video.demo import render


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence folder in the layout of OTB: 12 frames, the object absent in frames 5 to 7."""
    folder = tmp_path_factory.mktemp("sets") / "walk"
    (folder / "img").mkdir(parents=True)
    lines = []
    for number, (image, box) in enumerate(render(12, (160, 120))):
        assert box is not None
        cv2.imwrite(str(folder / "img" / f"{number + 1:04d}.png"), image)
        lines.append("nan,nan,nan,nan" if 5 <= number < 8 else str(box))
    (folder / "groundtruth_rect.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def sequence(walk: Path) -> Sequence:
    return find_sequences(walk)[0]


@pytest.fixture
def found(sequence: Sequence) -> np.ndarray:
    """Boxes a little beside the truth, float64 (12, 4)."""
    return np.nan_to_num(sequence.boxes, nan=30.0) + np.array([2, 1, 1, -1])
