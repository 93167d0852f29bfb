"""Comparison of two results: figures are worse or better by a share, and only results of one plan compare."""

import copy
import json

import pytest

from catstream.errors import SettingsError
from catstream.measure.load_compare import compare, read_result
from catstream.measure.load_report import to_json
from catstream.measure.load_test import LoadTest


@pytest.fixture
def before(result, tmp_path):
    """A result as it is read from its file."""
    (tmp_path / "x.json").write_text(
        json.dumps(to_json(LoadTest([], results=[result([0.01] * 50)]), {"command": "catstream loadtest"}))
    )
    return read_result(tmp_path / "x.json")


@pytest.fixture
def after(before):
    return copy.deepcopy(before)


def regressions(changes):
    return [change.name for change in changes if change.is_regression]


def test_result_has_no_regression_against_itself(before):
    assert regressions(compare(before, before, 0.0)) == []


@pytest.mark.parametrize(
    ("figures", "names"),
    [
        ({"p99": 0.0121, "p50": 0.0119, "p95": 0.001}, ["p99"]),
        ({"success": 0.7}, ["success"]),
        ({"success": 1.0, "skipped": 0.001}, ["skipped"]),  # it was 0
        ({"p99.9": 9.0, "max": 9.0, "model-max": 9.0}, []),
    ],
)
def test_figure_worse_by_more_than_the_tolerance_is_a_regression(before, after, figures, names):
    after["figures"] |= figures
    assert regressions(compare(before, after, 0.2)) == names


def test_results_of_different_plans_do_not_compare(before, after):
    after["plan"]["rate"] = 30.0
    after["settings"] = {"coreset.size": 32}
    with pytest.raises(SettingsError, match=r"different plans \(rate, settings\): 'catstream loadtest'"):
        compare(before, after, 0.1)


def test_searches_compare_by_their_highest_number(before, after):
    for each, streams in ((before, 5), (after, 4)):
        each |= {"find": "streams", "highest": streams}
        each["plan"]["streams"] = streams
    assert compare(before, after, 0.1) == [("highest streams", 5, 4, 0.2, True)]
    assert regressions(compare(after, before, 0.1)) == []


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"plan": 3}'])
def test_other_file_is_an_error(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(SettingsError, match="is not a result of a load test"):
        read_result(tmp_path / "x.json")
