"""Boxes at keyframes as text: parsed, and the same after they were written and read."""

import pytest

from catstream.base.box import Box
from catstream.errors import BoxError, CatstreamError, VideoError
from catstream.offline.keyframes import by_object, format_keyframe, parse_keyframe, read_keyframes, write_keyframes

DRAWN = {"anna": {0: Box(1.5, 2, 30, 40), 412: None, 413: "hidden"}, "": {7: Box(0.1, 0.2, 3, 4)}}


def test_file_of_keyframes_is_read_as_it_was_written(tmp_path):
    write_keyframes(tmp_path / "keyframes.csv", DRAWN, str(tmp_path.parent / "a.mp4"))
    assert by_object(read_keyframes(tmp_path / "keyframes.csv")) == DRAWN
    assert (tmp_path / "keyframes.csv").read_text().splitlines()[3:] == [
        "412,anna,absent,,,,../a.mp4",
        "413,anna,hidden,,,,../a.mp4",
    ]
    texts = [format_keyframe(name, frame, box) for name, boxes in DRAWN.items() for frame, box in boxes.items()]
    assert by_object(map(parse_keyframe, texts)) == DRAWN


def test_line_needs_no_columns_after_absent(tmp_path):
    (tmp_path / "boxes.csv").write_text("frame,object,x,y,w,h\n3,anna,Absent\n")
    assert read_keyframes(tmp_path / "boxes.csv") == [("anna", 3, None)]


@pytest.mark.parametrize(
    "text", ["anna=1,2,30,40", "anna@=1,2,30,40", "anna@-1=1,2,30,40", "anna@3=1,2,30", "a b@3=1,2,3,4"]
)
def test_malformed_keyframe_is_an_error(text):
    with pytest.raises(CatstreamError, match=r"@FRAME=|four numbers|not a name"):
        parse_keyframe(text)


@pytest.mark.parametrize(
    "line",
    ["3,anna,1,2,30", ",anna,1,2,30,40", "-1,anna,1,2,30,40", "3,anna,1,2,30,0", "3,a b,1,2,30,40", "3.5,anna,absent"],
)
def test_error_of_a_malformed_file_names_its_line(tmp_path, line):
    (tmp_path / "boxes.csv").write_text(f"frame,object,x,y,w,h\n0,anna,1,2,30,40\n{line}\n")
    with pytest.raises(VideoError, match="line 3"):
        read_keyframes(tmp_path / "boxes.csv")


def test_missing_file_of_keyframes_is_an_error(tmp_path):
    with pytest.raises(VideoError, match="cannot read "):
        read_keyframes(tmp_path / "boxes.csv")


def test_two_boxes_of_an_object_in_a_frame_are_an_error():
    with pytest.raises(BoxError, match="anna has two boxes in frame 3"):
        by_object([("anna", 3, None), ("ben", 3, None), ("anna", 3, Box(1, 2, 30, 40))])
