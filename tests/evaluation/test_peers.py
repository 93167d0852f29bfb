"""OpenCV's trackers: boxes that they accept, and model files that they need.

The trained networks are not included: OpenCV's classes of their trackers and parameters are real, the answers made up.
"""

from pathlib import Path
from unittest.mock import create_autospec

import cv2
import numpy as np
import pytest

from catstream.base.box import Box
from catstream.base.settings import Settings
from catstream.errors import BoxError, SettingsError
from catstream.evaluation import peers
from catstream.evaluation.nanotrack import NanoTrackV3
from catstream.evaluation.onepass import evaluate, follow
from catstream.evaluation.peers import MODELS, PEERS, Peer


@pytest.mark.parametrize("tracker", MODELS)
def test_a_tracker_gets_its_model_files_and_its_confidence_is_reported(tracker, sequence, tmp_path, monkeypatch):
    files = {parameter: str(tmp_path / name) for parameter, name in MODELS[tracker].items()}
    peer, given = create_autospec(getattr(cv2, PEERS[tracker]), instance=True), []
    peer.update.return_value, peer.getTrackingScore.return_value = (True, (1, 2, 30, 40)), 0.625
    home, name = (peers, "NanoTrackV3") if tracker == "nano-v3" else (cv2, f"{PEERS[tracker]}_create")
    monkeypatch.setattr(home, name, lambda parameters: given.append(parameters) or peer)
    for file in files.values():
        Path(file).touch()
    run = follow(tracker, Settings(), sequence, peer_models=tmp_path)
    assert {parameter: getattr(given[-1], parameter) for parameter in files} == files
    assert run.boxes[1:].tolist() == [[1, 2, 30, 40]] * (len(sequence) - 1)
    assert run.confidence.tolist() == [1] + [0.625] * (len(sequence) - 1)


def test_the_model_files_that_a_tracker_lacks_are_named_before_the_first_run(tmp_path, sequence):
    with pytest.raises(SettingsError, match=r"needs object_tracking_vittrack_2023sep.onnx: .* --peer-models"):
        evaluate([sequence], ["mil", "vit"], Settings())
    (tmp_path / "nanotrack_backbone_sim.onnx").touch()
    with pytest.raises(SettingsError, match=r"missing model file of .*: add nanotrack_head_sim.onnx"):
        evaluate([sequence], ["nano"], Settings(), peer_models=str(tmp_path))


@pytest.mark.parametrize("tracker", MODELS)
def test_a_model_file_that_opencv_cannot_read_is_one_line_of_error(tracker, tmp_path, capfd):
    for name in MODELS[tracker].values():
        (tmp_path / name).write_text("not a network")
    message = f"cannot read the model files of the tracker '{tracker}' .*: download"
    with pytest.raises(SettingsError, match=message) as caught:
        Peer(tracker, tmp_path)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_a_box_across_the_edge_of_the_frame_is_clipped_and_one_outside_is_an_error(sequence, monkeypatch):
    frame, peer = next(iter(sequence.frames())), Peer("mil")
    peer.init(frame, (-8.0, 90.0, 40.0, 40.0))
    assert peer.update(frame)[0]
    assert peer.score == 1
    with pytest.raises(BoxError, match="outside the frame of 160 x 120"):
        peer.init(frame, (-90, 0, 60, 60))
    broken = create_autospec(cv2.TrackerMIL, instance=True)
    broken.init.side_effect = cv2.error("assertion failed")
    monkeypatch.setattr(peer, "_create", lambda: broken)
    with pytest.raises(BoxError, match="does not accept the box 1,2,30,40"):
        peer.init(frame, (1, 2, 30, 40))


def test_a_tracker_missing_in_opencv_is_an_error_with_the_install_command(monkeypatch):
    monkeypatch.setitem(PEERS, "csrt", "TrackerThatIsNot")
    with pytest.raises(SettingsError, match=r"catstream\[peers\]"):
        Peer("csrt")


class Brightness:
    """A network for `NanoTrackV3`: the features are the picture, and the object is where it is brightest, 30 x 30."""

    def __init__(self, *_):
        self.inputs = {}

    def setInput(self, blob, name=""):
        self.inputs[name] = blob

    def forward(self, outputs=None):
        if outputs is None:
            return self.inputs[""]
        places = 127 + 16 * np.arange(-7, 8)
        light = cv2.blur(self.inputs["input2"][0].mean(axis=0), (61, 61))[np.ix_(places, places)]
        return np.stack([0 * light, light / 2 - 120])[None], np.full((1, 4, 15, 15), 30.0)


def test_nanotrack_moves_its_box_to_the_place_with_the_highest_score(monkeypatch):
    monkeypatch.setattr(cv2.dnn, "readNet", Brightness)
    tracker = NanoTrackV3(cv2.TrackerNano_Params())
    for step in range(6):
        frame = np.zeros((240, 320, 3), np.uint8)
        cv2.rectangle(frame, (100 + 10 * step, 80 + 10 * step), (139 + 10 * step, 119 + 10 * step), (255, 255, 255), -1)
        box = (100, 80, 40, 40)
        if step == 0:
            tracker.init(frame, box)
        else:
            _, box = tracker.update(frame)
        assert Box(*box).overlap(Box(100 + 10 * step, 80 + 10 * step, 40, 40)) > 0.6
    assert tracker.getTrackingScore() > 0.5
