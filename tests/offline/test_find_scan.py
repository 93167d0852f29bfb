"""The files that are searched, their frames, the scan of a frame, and the intervals of detections."""

import shutil
from fractions import Fraction
from itertools import pairwise

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import catstream
from catstream.base.box import Box
from catstream.errors import SettingsError, VideoError
from catstream.features.cells import Cells
from catstream.features.pyramid import Pyramid
from catstream.offline.find import Detection, load_models
from catstream.offline.find_files import find_files
from catstream.offline.find_results import FileResult
from catstream.offline.find_scan import Scan
from catstream.video.frames import Frame
from catstream.video.writer import VideoWriter


@pytest.fixture(scope="session")
def appearing(once, images):
    """A video in which the dahlia is seen in the frames 13 to 31 only."""

    def write(folder):
        height, width = images[0].shape[:2]
        with VideoWriter(folder / "appearing.mp4", 25, (width, height)) as writer:
            for number in range(40):
                image = images[number] if 13 <= number <= 31 else np.full_like(images[0], 128)
                writer.write(image)

    return once("appearing", write) / "appearing.mp4"


def test_find_yields_the_detections_of_all_paths_in_order(model_files, images, appearing, tmp_path):
    (folder := tmp_path / "folder").mkdir()
    for number, place in ((20, folder), (21, folder), (22, tmp_path)):
        cv2.imwrite(str(place / f"{number}.png"), images[number])
    found = list(catstream.find(model_files[0], [folder, appearing, tmp_path / "22.png"]))
    files = [detection.file for detection in found]
    assert list(dict.fromkeys(files)) == [str(folder), str(appearing), str(tmp_path / "22.png")]
    names = [detection.image for detection in found if detection.file == str(folder)]
    assert list(dict.fromkeys(names)) == ["20.png", "21.png"]
    assert {detection.object for detection in found} == {"dahlia"}


def test_unreadable_file_is_an_error_after_all_detections(model_files, appearing, tmp_path):
    (tmp_path / "damaged.mp4").write_bytes(appearing.read_bytes()[:2000])
    files = []
    with pytest.raises(VideoError, match="damaged"):
        files.extend(one.file for one in catstream.find(model_files[0], [tmp_path / "damaged.mp4", appearing]))
    assert set(files) == {str(appearing)}


def test_no_model_and_two_models_with_one_name_are_errors(model_files):
    with pytest.raises(SettingsError, match="duplicate model name 'dahlia'"):
        load_models([model_files[0], model_files[0]])
    with pytest.raises(SettingsError, match="missing model"):
        load_models([])


@pytest.mark.parametrize("number", [0, 40])
def test_several_models_find_the_windows_of_each_alone(learned, images, number, monkeypatch):
    def respond_above(cells, weights, bias, least):
        scores = cells.respond(weights, bias)
        return np.where(scores >= least, scores, -np.inf)

    frame = Pyramid(images[number])
    together = Scan(learned, 0.2).windows(frame)
    monkeypatch.setattr(Cells, "respond_above", respond_above)
    plain = [Scan([each], 0.2).windows(frame)[0] for each in learned]
    for ours, theirs in zip(together, plain, strict=True):
        assert [each.score for each in ours] == pytest.approx([each.score for each in theirs], abs=1e-4)
        np.testing.assert_allclose([each.window for each in ours], [each.window for each in theirs])


def test_object_is_found_at_its_box(learned, images, demo_video):
    for number in (20, 40, 59):
        dahlia, _ = Scan(learned)(images[number])
        assert dahlia[0].box.overlap(demo_video(60)[1][number]) > 0.6
        assert dahlia[0].score > 0.7


def test_detections_reach_the_threshold_and_do_not_overlap(learned, images):
    for found in Scan(learned, 0.1)(images[30]):
        assert [each.score for each in found] == sorted((each.score for each in found), reverse=True)
        assert all(each.score >= 0.1 for each in found)
        assert all(a.window.overlap(b.window) < 0.3 for k, a in enumerate(found) for b in found[:k])


def test_frame_without_the_object_has_no_detection(learned, rng):
    noise = rng.integers(0, 256, (240, 320, 3), np.uint8)
    for image in (noise, np.full((240, 320, 3), 128, np.uint8), np.zeros((9, 12, 3), np.uint8)):
        assert Scan(learned)(image) == [[], []]


seen = st.tuples(st.floats(0, 30), st.sampled_from(["anna", "ben"]), st.floats(0.5, 1), st.floats(0, 300))


@given(st.lists(seen, min_size=1, max_size=40))
def test_every_detection_is_in_one_interval_of_its_object(facts):
    result = FileResult("walk.mp4", "", 0, gap=1.0)
    made = [
        Detection(name, "walk.mp4", round(25 * time), time, Box(x, 50.0, 40.0, 40.0), score)
        for time, name, score, x in sorted(facts)
    ]
    for one in made:
        result.add(Frame(one.frame, one.time, np.zeros((60, 80, 3), np.uint8)), [one])
    assert sum(len(interval.detections) for interval in result.intervals) == len(made)
    for name in ("anna", "ben"):
        own = [interval for interval in result.intervals if interval.best.object == name]
        assert all(one.times[1] + 1.0 < other.times[0] for one, other in pairwise(own))
        for each in own:
            within = [one for one in made if one.object == name and each.times[0] <= one.time <= each.times[1]]
            assert each.detections == within
            assert each.best.score == max(one.score for one in within)


@pytest.fixture
def tree(tmp_path, video):
    """A folder with videos, images and other files."""
    for place in ("clips/a.mp4", "clips/deep/b.MP4"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(video, tmp_path / place)
    (tmp_path / "photos").mkdir()
    for number in (10, 9, 1):
        cv2.imwrite(str(tmp_path / "photos" / f"{number}.png"), np.full((20 + number, 30, 3), number, np.uint8))
    (tmp_path / "photos" / "notes.txt").write_text("no picture")
    (tmp_path / ".hidden").mkdir()
    shutil.copy(video, tmp_path / ".hidden" / "c.mp4")
    return tmp_path


def frames(file):
    problems = []
    searched = file.frames(0.0, problems)
    return [(frame.number, name, frame.image.shape) for frame, name in searched], problems


def names(tree, *paths):
    return [str(file.path.relative_to(tree)) for file in find_files(paths or [tree])]


EVERYTHING = ["clips/a.mp4", "clips/deep/b.MP4", "photos"]


def test_folder_is_searched_deeply_and_each_file_once(tree):
    (tree / "loop").symlink_to(tree)
    (tree / "z.mp4").symlink_to(tree / "clips" / "a.mp4")
    (tree / "z-folder").symlink_to(tree / "photos")
    (tree / "photos" / "z.png").symlink_to(tree / "photos" / "9.png")
    assert names(tree) == names(tree, tree, tree, tree / "clips", tree / "z.mp4") == EVERYTHING
    assert names(tree, tree / "photos" / "9.png", tree) == ["photos/9.png", *EVERYTHING]
    assert [name for _, name, _ in frames(find_files([tree / "photos"])[0])[0]] == ["1.png", "9.png", "10.png"]


def test_hidden_folders_are_skipped_and_other_kinds_counted(tree, caplog):
    for name in ("d.heic", "e.heic", "f"):
        shutil.copy(tree / "clips" / "a.mp4", tree / "clips" / name)
    assert names(tree) == EVERYTHING
    assert "not searched: 2 .heic, 1 file without a suffix, 1 .txt (name" in caplog.text
    assert names(tree, tree / ".hidden") == [".hidden/c.mp4"]


def test_images_have_their_sizes_and_errors_are_reported(tree):
    (tree / "photos" / "8.png").write_bytes(b"no picture")
    cv2.imwritemulti(str(tree / "a.tif"), [np.zeros((20, 30 + page), np.uint8) for page in range(3)])
    folder, several = find_files([tree / "photos", tree / "a.tif"])
    found, (unreadable,) = frames(folder)
    assert found == [(0, "1.png", (21, 30, 3)), (2, "9.png", (29, 30, 3)), (3, "10.png", (30, 30, 3))]
    assert "8.png" in unreadable
    assert frames(several)[0] == [(page, "", (20, 30 + page, 3)) for page in range(3)]


def test_video_is_searched_by_time(tmp_path):
    times = [0.0, 0.01, 0.05, 0.19, 0.2, 0.31, 0.6, 0.61, 3.0, 3.01]
    with av.open(str(tmp_path / "a.ts"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for time in times:
            frame = av.VideoFrame(160, 120, "yuv420p")
            frame.pts, frame.time_base = round(1000 * time), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    steps = find_files([tmp_path / "a.ts"])[0].frames(0.2, [])
    assert [frame.number for frame, _ in steps] == [0, 4, 6, 8]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.mp4", "no file or folder"),
        ("empty", "no images or videos: "),
        ("texts", r"no images or videos \(1 \.txt\)"),
        ("rtsp://a:b@c/d", "no file or folder 'rtsp://c/d'"),
    ],
)
def test_path_without_images_or_videos_is_an_error(tmp_path, name, message, monkeypatch):
    (tmp_path / "empty").mkdir()
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.txt").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(VideoError, match=message):
        find_files([name])
