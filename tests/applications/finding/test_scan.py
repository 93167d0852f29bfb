"""The scan of a frame for several models at once."""

import numpy as np
import pytest

from catstream.applications.finding.find import Scan
from catstream.features.cells import Cells
from catstream.features.pyramid import Pyramid


def every_window(cells, weights, bias, least):
    """As `Cells.respond_above`, with the score of every window computed to the end."""
    scores = cells.respond(weights, bias)
    return np.where(scores >= least, scores, -np.inf)


@pytest.mark.parametrize("number", [0, 20, 40, 59])
@pytest.mark.parametrize("threshold", [0.2, 0.5])
def test_models_together_find_the_windows_of_each_models_plain_scan(learned, images, number, threshold, monkeypatch):
    frame = Pyramid(images[number])
    together = Scan(learned, threshold).windows(frame)
    monkeypatch.setattr(Cells, "respond_above", every_window)
    plain = [Scan([each], threshold).windows(frame)[0] for each in learned]
    for ours, theirs in zip(together, plain, strict=True):
        assert [each.score for each in ours] == pytest.approx([each.score for each in theirs], abs=1e-4)
        np.testing.assert_allclose([each.window for each in ours], [each.window for each in theirs])


def test_the_object_is_found_at_its_box(learned, images, demo_video):
    for number in (20, 40, 59):
        dahlia, _ = Scan(learned)(images[number])
        assert dahlia[0].box.overlap(demo_video(60)[1][number]) > 0.6
        assert dahlia[0].score > 0.7


def test_every_sighting_reaches_the_threshold_and_overlaps_no_better_one(learned, images):
    for found in Scan(learned, 0.1)(images[30]):
        assert [each.score for each in found] == sorted((each.score for each in found), reverse=True)
        assert all(each.score >= 0.1 for each in found)
        assert all(a.window.overlap(b.window) < 0.3 for k, a in enumerate(found) for b in found[:k])


def test_a_frame_without_the_object_or_smaller_than_a_window_has_no_sighting(learned, rng):
    noise = rng.integers(0, 256, (240, 320, 3), np.uint8)
    for image in (noise, np.full((240, 320, 3), 128, np.uint8), np.zeros((9, 12, 3), np.uint8)):
        assert Scan(learned)(image) == [[], []]
