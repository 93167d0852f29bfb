"""OpenCV's trackers: boxes that they accept, and model files that they need.

The trained networks are not included: OpenCV's classes of their trackers and parameters are real, the answers made up.
"""

from pathlib import Path
from unittest.mock import create_autospec

import cv2
import pytest

from catstream.base.settings import Settings
from catstream.errors import BoxError, SettingsError
from catstream.evaluation.onepass import evaluate, follow
from catstream.evaluation.peers import MODELS, PEERS, Peer


@pytest.mark.parametrize("tracker", MODELS)
def test_a_tracker_gets_its_model_files_and_its_confidence_is_reported(tracker, sequence, tmp_path, monkeypatch):
    files = {parameter: str(tmp_path / name) for parameter, name in MODELS[tracker].items()}
    peer, given = create_autospec(getattr(cv2, PEERS[tracker]), instance=True), []
    peer.update.return_value, peer.getTrackingScore.return_value = (True, (1, 2, 30, 40)), 0.625
    monkeypatch.setattr(cv2, f"{PEERS[tracker]}_create", lambda parameters: given.append(parameters) or peer)
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
