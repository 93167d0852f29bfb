"""The attributes of sequences: by the definitions of the benchmarks, and from a file."""

from __future__ import annotations

import numpy as np
import pytest

from catstream.applications.evaluation.datasets import attributes_of, computed_attributes, read_attributes
from catstream.errors import SettingsError


@pytest.mark.parametrize(
    ("last", "attributes"),
    [
        ((60, 50, 40, 30), []),
        ((80, 50, 40, 30), []),
        ((81, 50, 40, 30), ["fast motion"]),
        ((60, 44, 56, 43), ["scale variation"]),
        ((60, 60, 27, 22), ["scale variation"]),
        ((55, 40, 50, 40), []),
        ((55, 58, 50, 18), ["aspect change"]),
        ((70, 48, 20, 32), ["aspect change"]),
        ((70, 57, 21, 19), ["scale variation", "low resolution"]),
        ((np.nan,) * 4, ["out of view"]),
    ],
)
def test_a_change_of_the_box_is_an_attribute_beyond_its_limit(last, attributes):
    boxes = np.array([(60, 50, 40, 30), last], float)
    assert computed_attributes(boxes, (160, 120)) == attributes


@pytest.mark.parametrize("box", [(-2, 50, 40, 30), (60, -2, 40, 30), (122, 50, 40, 30), (60, 92, 40, 30)])
def test_a_box_across_the_border_of_the_frame_is_out_of_view(box):
    assert computed_attributes(np.array([box], float), (160, 120)) == ["out of view"]
    assert computed_attributes(np.array([box], float).clip([-1, -1, 0, 0], [121, 91, 40, 30]), (160, 120)) == []


def test_motion_across_frames_without_the_object_is_not_fast():
    boxes = np.array([(10, 50, 40, 30), (np.nan,) * 4, (100, 50, 40, 30)], float)
    assert computed_attributes(boxes, (160, 120)) == ["out of view"]


def test_the_attributes_of_a_file_join_those_of_the_ground_truth(sequence):
    found = attributes_of([sequence], {"walk": ["blur", "out of view", "blur"], "other": ["clutter"]})
    assert found == {"blur": ["walk"], "out of view": ["walk"]}


@pytest.mark.parametrize("content", [b"{", b"[]", b'{"walk": "blur"}', b'{"a": [1]}', b'{"\xff": []}'])
def test_a_file_of_attributes_in_another_form_is_an_error(tmp_path, content):
    file = tmp_path / "attributes.json"
    file.write_bytes(content)
    for path in (file, tmp_path / "missing.json"):
        with pytest.raises(SettingsError, match="cannot read the attributes"):
            read_attributes(path)
