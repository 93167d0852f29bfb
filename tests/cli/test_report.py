"""`catstream report`: its tables, its pictures, and its errors."""

import csv
import json
import re

import pytest

from catstream.base.box import Box
from catstream.errors import VideoError
from catstream.output.destinations import Header
from catstream.video.source import open_source
from catstream.wire.messages import Track
from tests.video.pictures import damaged, make_video

STATES = "PPPPDDAAPP"  # present, doubtful, absent


def write_log(path, source="", names=("anna",), size=(320, 240), states=STATES):
    lines = [Header(source=source, size=size, rate=10.0, frames=len(states)).to_json()]
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


def test_report_has_shares_distance_and_speed_of_each_object(succeed, fail, tmp_path):
    log = write_log(tmp_path / "walk.ndjson", "/nowhere.mp4")
    _, errors = succeed("report", log)
    assert "walk: no pictures (there is no video or folder '/nowhere.mp4'" in errors
    page = (tmp_path / "walk.html").read_text()
    # Six steps of 3 and 4 pixels, five of 0.1 s before the absence, and one after it.
    row = ["anna", "10", "60.0%", "20.0%", "20.0%", "-", "0.8 s", "30 px", "50 px/s", "50 px/s"]
    assert row in cells(page)
    assert re.findall(r'<i class="(\w+)" title="(.*?)" style="left:(.*?)%;width:(.*?)%">', page) == [
        ("present", "present, 0:00.0 to 0:00.4, frames 0 to 3", "0.00", "40.00"),
        ("doubtful", "doubtful, 0:00.4 to 0:00.6, frames 4 to 5", "40.00", "20.00"),
        ("present", "present, 0:00.8 to 0:01.0, frames 8 to 9", "80.00", "20.00"),
    ]
    assert "exists already" in fail("report", log)
    succeed("report", log, "--scale", "0.05mm", "--overwrite")
    assert [*row[:7], "1.50 mm", "2.50 mm/s", "2.50 mm/s"] in cells((tmp_path / "walk.html").read_text())
    with (tmp_path / "walk-objects.csv").open() as file:
        (figures,) = csv.DictReader(file)
    assert figures == {
        **{"video": "walk", "object": "anna", "frames": "10", "present": "0.6", "doubtful": "0.2", "absent": "0.2"},
        **{"checked": "0", "seconds": "0.8", "distance": "1.5", "mean_speed": "2.5", "maximum_speed": "2.5"},
        "unit": "mm",
    }
    assert "with its unit, for example 0.05mm" in fail("report", log, "--scale", "5", "--overwrite")


def test_reused_names_and_outages_are_not_joined(succeed, tmp_path):
    """Two objects named ben stand still in frames 100 to 119 of a video, which is lost for a minute in the middle."""
    lines = [Header(rate=10.0, start=100).to_json()]
    for number in range(20):
        box, began = (Box(10, 10, 20, 20), 0) if number < 5 else (Box(300, 200 if number < 10 else 0, 20, 20), 5)
        time = 10 + number / 10 + (60 if number >= 10 else 0)
        track = Track(number, time, "present", box, 0.9, 1, object="ben", began=began, source_frame=100 + number)
        lines.append(json.dumps(track.to_dict()))
    (tmp_path / "walk.ndjson").write_text("\n".join(lines) + "\n")
    succeed("report", tmp_path / "walk.ndjson")
    page = (tmp_path / "walk.html").read_text()
    assert [(row[0], *row[6:8]) for row in cells(page) if row] == [
        ("ben", "0.5 s", "0 px"),
        ("ben@105", "1.5 s", "0 px"),
    ]
    assert re.findall(r'title="present, (.*?)" style="left:(.*?)%', page) == [
        ("0:10.0 to 0:10.5, frames 100 to 104", "0.00"),
        ("0:10.5 to 0:11.0, frames 105 to 109", "0.81"),
        ("1:11.0 to 1:12.0, frames 110 to 119", "98.39"),
    ]


def test_report_has_pictures_of_doubtful_stretches(walk, succeed, tmp_path):
    log = write_log(tmp_path / "walk.ndjson", str(walk / "img"), states="PPPPDDDPPP")
    _, errors = succeed("report", log, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "frame 5, " in page
    assert "anna, 3 doubtful frames" in page
    assert page.count("data:image/jpeg") == 1
    assert not errors


def test_report_has_pictures_of_frames_after_damage(succeed, tmp_path):
    video = damaged(make_video(tmp_path / "walk.mpg", 40, {"v:g": "4"}), 0.25)
    with open_source(video) as source, pytest.raises(VideoError, match="is damaged at frame"):
        list(source)
    succeed("report", write_log(tmp_path / "walk.ndjson", str(video), size=(160, 120), states="P" * 24 + "DDDP"))
    assert "frame 25, " in (tmp_path / "walk.html").read_text()


def test_report_of_a_folder_has_a_section_for_each_log(succeed, tmp_path):
    write_log(tmp_path / "a&b.ndjson", names=("anna", "ben"))
    write_log(tmp_path / "c.ndjson", size=None)
    succeed("report", tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert re.findall(r"<h2>(.*?) <small>", page) == ["a&amp;b", "c"]
    assert len(re.findall("<polyline", page)) == 3  # two frames after the absence are too few for a mean


def test_rotated_logs_are_one_section_with_a_gap(succeed, tmp_path):
    whole = write_log(tmp_path / "gate.ndjson", states="PPPPPPPPPP").read_text().splitlines(keepends=True)
    (tmp_path / "gate-20261128T000000.ndjson").write_text("".join(whole[:5]))
    (tmp_path / "gate.ndjson").write_text("".join([whole[0], Header(gap=3).to_json() + "\n", *whole[8:]]))
    write_log(tmp_path / "gate-2.ndjson")
    _, errors = succeed("report", tmp_path, tmp_path / "page.html")
    assert "gate: the log lacks 3 frames" in errors
    page = (tmp_path / "page.html").read_text()
    assert re.findall(r"<h2>(.*?) <small>", page) == ["gate-2", "gate"]
    assert re.findall(r'"(present, .*?)" style="left:(.*?)%;width:(.*?)%">', page)[-2:] == [
        ("present, 0:00.0 to 0:00.4, frames 0 to 3", "0.00", "40.00"),
        ("present, 0:00.7 to 0:01.0, frames 7 to 9", "70.00", "30.00"),
    ]
    assert [row[6:9] for row in cells(page) if row][-1] == ["0.7 s", "25 px", "50 px/s"]


@pytest.mark.parametrize(
    ("name", "words"), [("none.ndjson", "pass"), ("walk.txt", "pass"), ("empty", "pass"), ("a.ndjson", "no track")]
)
def test_report_of_invalid_input_is_an_error(fail, tmp_path, name, words):
    (tmp_path / "walk.txt").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.ndjson").write_text(Header().to_json() + "\n")
    assert words in fail("report", tmp_path / name)
