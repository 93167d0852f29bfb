"""Search: the features and the score of every window in a part of a frame, and the highest of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from catstream.base.box import Window
from catstream.base.settings import Settings
from catstream.detection import search
from catstream.detection.context import FrameContext
from catstream.detection.search import due_part
from catstream.features.cells import Cells
from catstream.features.pyramid import Pyramid, Region
from catstream.features.score_map import ScoreMap, non_maximum_suppression
from catstream.messages.kinds import Model


def test_the_window_of_a_score_lies_in_the_frame_and_place_is_its_inverse(image):
    window = Window(30, 40, 50, 70)
    scores = ScoreMap.around(Pyramid(image), window, 20, None)
    assert scores.window(6, 6) == pytest.approx(window)
    assert scores.place(scores.window(2.25, 7.5)) == pytest.approx((2.25, 7.5))


def test_windows_of_a_region_lie_in_it(image, rng):
    model = Model(1, 0, rng.normal(size=len(Cells.of(image).row(0, 0))).astype(np.float32), 0.0)
    scores = ScoreMap.within(Pyramid(image), Region(40, 20, 100, 90), Window(0, 0, 40, 40), model)
    assert scores.origin == (40, 20)
    last = scores.window(*np.subtract(scores.scores.shape, 1))
    assert (last.x + last.w, last.y + last.h) == pytest.approx((140, 110))


@given(st.integers(0, 10**6), st.integers(1, 30), st.integers(1, 60))
def test_each_part_is_due_once_in_an_interval_or_in_as_many_frames_as_parts(seq, interval, count):
    frames = max(interval, count)
    parts = [part for number in range(seq, seq + frames) if (part := due_part(number, interval, count)) is not None]
    assert sorted(parts) == list(range(count))


@pytest.fixture
def visited(monkeypatch):
    """The regions that are searched, with the size of their windows, in order."""
    found = []

    def within(_, region, window, __, **___):
        found.append((region, window))
        return ScoreMap(Cells.of(np.zeros((64, 64, 3), np.uint8)), np.zeros((1, 1), np.float32), (0.0, 0.0), (1.0, 1.0))

    monkeypatch.setattr(ScoreMap, "within", within)
    return found


@pytest.mark.parametrize("side", [6, 20, 60])
@pytest.mark.parametrize("interval", [1, 10])
def test_a_round_searches_each_window_of_each_size_within_the_budget_of_a_frame(visited, side, interval):
    frame, window, model = Pyramid(np.zeros((240, 320, 3), np.uint8)), Window(100, 90, side, side), Model(0, 0, None, 0)
    for seq in range(200):
        before = len(visited)
        search._search_elsewhere(FrameContext(frame, model, Settings(), seq), window, interval)
        assert sum(region.cells(sized) for region, sized in visited[before:]) < 1.2 * 16_384
    for factor in (0.8, 1.0, 1.25):
        w = side * factor
        parts = [region for region, sized in visited if sized.w == pytest.approx(w)]
        for x, y in np.random.default_rng(1).uniform(0, (320 - w, 240 - w), (50, 2)):
            assert any(r.left <= x <= r.left + r.width - w and r.top <= y <= r.top + r.height - w for r in parts)


def test_a_maximum_between_cells_is_interpolated_from_its_neighbours(image):
    row, column = np.mgrid[:9, :9]
    scores = (1 - 0.01 * ((row - 4.3) ** 2 + (column - 3.8) ** 2)).astype(np.float32)
    found = ScoreMap(Cells.of(image[:128, :128]), scores, (0, 0), (1, 1))
    _, window = found.best()
    assert (window.y, window.x) == pytest.approx((4.3, 3.8), abs=1e-3)


def test_maxima_suppress_their_neighbours_and_stop_at_the_threshold(rng):
    scores = rng.normal(size=(30, 40)).astype(np.float32)
    found = non_maximum_suppression(scores, 12, radius=3)
    values = [scores[place] for place in found]
    assert values == sorted(values, reverse=True)
    assert values[0] == scores.max()
    for i, (row, column) in enumerate(found):
        assert all(max(abs(row - r), abs(column - c)) > 3 for r, c in found[:i])
    assert non_maximum_suppression(np.eye(5, dtype=np.float32), 9, radius=1, threshold=0.5) == [(0, 0), (2, 2), (4, 4)]
