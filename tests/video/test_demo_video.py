"""The demo video: reproducible, with an occlusion and an absence."""

from __future__ import annotations

import numpy as np

from catstream.video.rendered import FRAMES, render, write
from catstream.video.source import open_source


def test_same_arguments_render_the_same_pixels():
    for (image, box), (again, other) in zip(render(5, (160, 120)), render(5, (160, 120)), strict=True):
        np.testing.assert_array_equal(image, again)
        assert box == other


def test_dahlia_is_occluded_once_and_leaves_once():
    absent = np.array([box is None for _, box in render(FRAMES, (160, 120))])
    edges = np.flatnonzero(np.diff(absent.astype(int)))
    assert len(edges) == 4
    assert 90 < absent.sum() < 150
    assert not absent[0]
    assert not absent[-1]


def test_video_is_written_with_its_ground_truth(tmp_path):
    steps: list[int] = []
    path, truth = write(tmp_path / "demo", 4, (160, 120), done=steps.append)
    assert steps == [1, 2, 3, 4]
    with open_source(tmp_path / "demo") as source:
        assert (source.name, source.size, source.rate) == ("demo", (160, 120), 30)
        assert sum(1 for _ in source) == len(truth) == 4
    rows = np.loadtxt(path.with_name("groundtruth_rect.txt"), delimiter=",")
    np.testing.assert_allclose(rows, np.array(truth, float), atol=1e-3)
