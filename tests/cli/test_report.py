"""`catstream report`: the numbers of its tables, its pictures, and what it says if there are none."""

import json
import re

import pytest

from catstream.base.box import Box
from catstream.messages.kinds import Track
from catstream.sinks.destinations import Head

STATES = "PPPPDDAAPP"  # present, doubtful, absent


def write_log(path, source="", names=("anna",), size=(320, 240), states=STATES):
    lines = [Head(source=source, size=size, rate=10.0, frames=len(states)).to_json()]
    for number, state in enumerate(states):
        for name in names:
            box = None if state == "A" else Box(3 * number, 4 * number, 20, 30)
            shown = "absent" if box is None else "present"
            track = Track(number, number / 10, shown, box, 0.9, 1, object=name, doubtful=state == "D")
            lines.append(json.dumps(track.to_dict()))
    path.write_text("\n".join(lines) + "\n")
    return path


def cells(page):
    return [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", page, re.S)]


def test_a_report_has_shares_distance_and_mean_speed_of_each_object(succeed, fail, tmp_path):
    log = write_log(tmp_path / "walk.ndjson", "/nowhere.mp4")
    _, errors = succeed("report", log)
    assert "walk: no pictures (there is no video or folder '/nowhere.mp4'" in errors
    page = (tmp_path / "walk.html").read_text()
    # Six steps of 3 and 4 pixels, five of 0.1 s before the absence, and one after it.
    assert ["anna", "10", "60.0%", "20.0%", "20.0%", "-", "30 px", "50 px/s"] in cells(page)
    assert re.findall(r'<i class="(\w+)" title="(.*?)" style="left:(.*?)%;width:(.*?)%">', page) == [
        ("present", "present, 0:00.0 to 0:00.4, frames 0 to 3", "0.00", "40.00"),
        ("doubtful", "doubtful, 0:00.4 to 0:00.6, frames 4 to 5", "40.00", "20.00"),
        ("present", "present, 0:00.8 to 0:01.0, frames 8 to 9", "80.00", "20.00"),
    ]
    assert "exists already" in fail("report", log)


def test_the_pictures_of_a_report_are_the_middles_of_doubtful_stretches(walk, succeed, tmp_path):
    log = write_log(tmp_path / "walk.ndjson", str(walk / "img"), states="PPPPDDDPPP")
    _, errors = succeed("report", log, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "frame 5, " in page
    assert "anna, 3 doubtful frames" in page
    assert page.count("data:image/jpeg") == 1
    assert not errors


def test_the_logs_of_a_folder_have_a_section_each_and_names_are_escaped(succeed, tmp_path):
    write_log(tmp_path / "a&b.ndjson", names=("anna", "ben"))
    write_log(tmp_path / "c.ndjson", size=None)
    succeed("report", tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert re.findall(r"<h2>(.*?) <small>", page) == ["a&amp;b", "c"]
    assert len(re.findall("<polyline", page)) == 3 * 2


@pytest.mark.parametrize(
    ("name", "words"), [("none.ndjson", "pass"), ("walk.txt", "pass"), ("empty", "pass"), ("a.ndjson", "no track")]
)
def test_a_report_of_something_else_is_an_error_of_one_line(fail, tmp_path, name, words):
    (tmp_path / "walk.txt").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.ndjson").write_text(Head().to_json() + "\n")
    assert words in fail("report", tmp_path / name)
