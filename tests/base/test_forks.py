"""Copies of a process: what they inherited is recognised, and functions that were registered are called there."""

import os

import pytest

from catstream.base import forks
from catstream.errors import ServiceError


def test_only_a_copy_of_the_process_that_made_an_object_is_refused(monkeypatch):
    calls = []
    monkeypatch.setattr(forks.os, "register_at_fork", lambda after_in_child: calls.append(after_in_child))
    forks.after_fork(list)
    assert calls == [list]
    since = forks.generation()
    forks.check_not_forked(since)
    if not (child := os.fork()):
        own = forks.generation()
        try:
            forks.check_not_forked(since)
        except ServiceError:
            os._exit(7 if forks.forked(since) and not forks.forked(own) else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    with pytest.raises(ServiceError, match="after a fork"):
        forks.check_not_forked(since + 1)
