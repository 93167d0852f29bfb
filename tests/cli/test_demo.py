"""`catstream demo`, from the photographs to the annotated video."""

import re

from catstream.video.source import open_source


def test_demo_is_tracked_and_annotated(succeed, tmp_path):
    output, _ = succeed("demo", "--output", tmp_path, "--frames", 25)
    success = re.search(r"success rate: ([\d.]+)", output)
    assert success
    assert float(success[1]) > 0.9
    with open_source(tmp_path / "tracks" / "demo.mp4") as source:
        assert sum(1 for _ in source) == 25


def test_render_only_starts_no_pipeline(succeed, tmp_path):
    succeed("demo", "--output", tmp_path, "--frames", 2, "--render-only")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["demo.mp4", "groundtruth_rect.txt"]


def test_box_of_a_live_demo_is_printed(succeed):
    assert succeed("demo", "--live", "demo:1") == ("184,88,57,58\n", "")
