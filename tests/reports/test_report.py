"""Reports: curves where they belong, in one colour for each tracker, and nothing that is not escaped."""

import re

import numpy as np
import pytest
from jinja2 import UndefinedError

from catstream.base.settings import Settings
from catstream.reports.report import COLOURS, Plot, write_page

SHARES = np.linspace(0, 1, 21)


def report(path, *plots):
    values = {"sequences": 1, "frames": 1, "runs": 1, "errors": ["<b>"], "flips": [], "headings": [], "rows": []}
    return write_page(path, "evaluation.html", **values, plots=plots, means=0, attributes=[], settings=Settings())


def test_a_curve_goes_from_its_first_to_its_last_point(tmp_path):
    plot = Plot.of("Success", "IoU", SHARES, {"a & b": 1 - SHARES})
    page = report(tmp_path / "report.html", plot).read_text()
    (points,) = re.findall(r'points="([^"]*)"', page)
    assert (points.split()[0], points.split()[-1], len(points.split())) == ("46.0,36.0", "436.0,276.0", 21)
    assert "a &amp; b" in page


def test_a_tracker_has_one_colour_in_all_plots_of_a_report():
    one = Plot.of("Success", "IoU", SHARES, {"first 0.9": SHARES, "second 0.1": SHARES})
    other = Plot.of("Precision", "pixels", SHARES, {"first 0.2": SHARES, "second 0.8": SHARES})
    assert [*one.colours.values()] == [*other.colours.values()] == [*COLOURS[:2]]


def test_all_values_are_escaped(tmp_path):
    assert "Not included: &lt;b&gt;" in report(tmp_path / "report.html").read_text()


def test_a_value_that_a_template_lacks_is_an_error(tmp_path):
    with pytest.raises(UndefinedError):
        write_page(tmp_path / "report.html", "loadtest.html", verdicts=[])
    assert not (tmp_path / "report.html").exists()
