"""The process of the trainer: the import of filterpy does not delay the models of a file."""

from contextlib import nullcontext
from unittest.mock import Mock

import numpy as np
import pytest

from catstream.base.settings import Settings
from catstream.processes import trainer
from catstream.wire.messages import End, Sample


@pytest.mark.parametrize(("lag", "centres"), [(25, 0), (0, 64)])
def test_only_models_in_lockstep_wait_for_filterpy(monkeypatch, lag, centres):
    trained, settings = [], Settings().replace({"run.lag_frames": lag})
    messages = [Sample(1, 70, {}, np.zeros((64, 2)), "anna"), End(71, "the source has ended")]
    monkeypatch.setattr(trainer, "Subscriber", lambda *_: nullcontext(Mock(receive=lambda _: messages.pop(0))))
    monkeypatch.setattr(trainer, "Publisher", lambda *_: nullcontext(Mock()))
    monkeypatch.setattr(trainer, "Trainer", lambda _: Mock(train=trained.append))
    ending = Mock(reason="", receive=lambda end: setattr(ending, "reason", end.reason))
    trainer.main(Mock(settings=settings, ending=ending))
    assert [len(sample.centres) for sample in trained] == [centres]
