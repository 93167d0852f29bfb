"""The search of videos and images."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest

import catstream
from catstream.applications.finding.find import File, Search, load_models
from catstream.applications.finding.found import SearchLog
from catstream.errors import ProtocolError, ServiceError, SettingsError, VideoError
from catstream.video.writer import VideoWriter


@pytest.fixture(scope="session")
def search(model_files):
    return Search(load_models(model_files))


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


def finished(log, file, search, steps=None):
    """Search a file to its end, or so many steps of it."""
    result = log.begin(file)
    for number, step in enumerate(() if result.complete else search.file(file)):
        if number == steps:
            return result
        result.add(step)
    log.end(result)
    return result


def test_one_frame_in_a_time_is_searched_and_the_last_one(search, appearing):
    file = File(appearing, "video")
    steps = list(search.file(file))
    assert [step.frame.number for step in steps] == [*range(0, 40, 5), 39]
    seen = [each.frame for step in steps for each in step.sightings if each.object == "dahlia"]
    assert list(dict.fromkeys(seen)) == [15, 20, 25, 30]
    rare = dataclasses.replace(search, every=1.2)
    assert [step.frame.number for step in rare.file(file)] == [0, 30, 39]


def test_a_search_that_was_interrupted_finds_the_same_as_one_that_was_not(search, appearing, video, tmp_path):
    files = File(video, "video"), File(appearing, "video")
    with SearchLog(tmp_path / "whole", search.description) as log:
        whole = [finished(log, file, search) for file in files]
    with SearchLog(tmp_path / "cut", search.description) as log:
        finished(log, files[0], search)
        finished(log, files[1], search, 4)
    with (tmp_path / "cut").open("ab") as stream:
        stream.write(b'{"file":"half a li')  # a process was killed in a write
    with SearchLog(tmp_path / "cut", search.description) as log:
        assert log.begin(files[0]).complete
        assert not log.begin(files[1]).complete
        assert [finished(log, file, search) for file in files] == whole
    with SearchLog(tmp_path / "cut", search.description) as log:
        assert list(log.results.values()) == whole
        assert all(interval.picture.startswith(b"\xff\xd8") for each in whole for interval in each.intervals)


def test_a_file_that_has_changed_is_searched_anew(search, appearing, video, tmp_path):
    path = shutil.copy(appearing, tmp_path / "one.mp4")
    with SearchLog(tmp_path / "log", search.description) as log:
        finished(log, File(path, "video"), search)
        assert log.begin(File(path, "video")).complete
        shutil.copy(video, path)
        assert not log.begin(File(path, "video")).complete


def test_the_log_of_another_search_is_not_continued(search, tmp_path):
    with SearchLog(tmp_path / "log", search.description):
        pass
    other = dataclasses.replace(search, threshold=0.7)
    with pytest.raises(ServiceError, match="differs in threshold"):
        SearchLog(tmp_path / "log", other.description)
    with SearchLog(tmp_path / "log", other.description, overwrite=True) as log:
        assert not log.results


@pytest.mark.parametrize(
    "content", ["[]\n", '{"kind":"catstream find 2"}\n', "no json\n", '{"kind":"catstream find 3"}\n']
)
def test_a_file_that_is_no_log_is_an_error_and_stays(search, tmp_path, content):
    (tmp_path / "log").write_text(content)
    with pytest.raises(ServiceError, match="is not the log of a search"):
        SearchLog(tmp_path / "log", search.description)
    assert (tmp_path / "log").read_text() == content


def test_find_yields_the_sightings_of_all_paths_in_order(model_files, images, appearing, tmp_path):
    for number in (20, 21):
        cv2.imwrite(str(tmp_path / f"{number}.png"), images[number])
    found = list(catstream.find(model_files[0], [tmp_path, appearing, tmp_path / "20.png"]))
    files = [sighting.file for sighting in found]
    assert list(dict.fromkeys(files)) == [str(tmp_path), str(appearing), str(tmp_path / "20.png")]
    names = [sighting.image for sighting in found if sighting.file == str(tmp_path)]
    assert list(dict.fromkeys(names)) == ["20.png", "21.png"]
    assert {sighting.object for sighting in found} == {"dahlia"}


def test_an_unreadable_file_is_an_error_after_the_sightings_of_the_others(model_files, appearing, tmp_path):
    (tmp_path / "damaged.mp4").write_bytes(appearing.read_bytes()[:2000])
    found, sightings = [], catstream.find(model_files[0], [tmp_path / "damaged.mp4", appearing])
    with pytest.raises(VideoError, match="damaged"):
        found.extend(sighting.file for sighting in sightings)
    assert set(found) == {str(appearing)}


def test_models_without_a_file_or_with_one_name_are_errors(model_files, tmp_path):
    with pytest.raises(ServiceError, match="no saved model"):
        load_models([tmp_path / "none.model"])
    with pytest.raises(SettingsError, match="named 'dahlia'"):
        load_models([model_files[0], model_files[0]])
    with pytest.raises(SettingsError, match="at least one model"):
        load_models([])
    (tmp_path / "cut.model").write_bytes(model_files[0].read_bytes()[:500])
    with pytest.raises(ProtocolError):
        load_models([tmp_path / "cut.model"])


@pytest.mark.parametrize("sizes", [(2, 1), (0, 1), (1, np.nan), (1, np.inf)])
def test_sizes_are_two_positive_numbers_in_order(model_files, appearing, sizes):
    with pytest.raises(SettingsError, match="the smaller one first, got"):
        catstream.find(model_files[0], appearing, sizes=sizes)
