"""The connection to a cluster, with a stand-in for Ray."""

from __future__ import annotations

import os
import socket
import sys
import types
from importlib.machinery import ModuleSpec

import pytest

from catstream.errors import FleetError
from catstream.fleet.cluster import connect


def test_a_head_that_dies_while_a_command_connects_is_not_asked_for_a_quarter_of_an_hour(monkeypatch):
    tries = []

    def init(*_, **__):
        tries.append(os.environ["RAY_NUM_REDIS_GET_RETRIES"])
        raise ConnectionError("it has died")

    ray = types.ModuleType("ray")
    ray.__spec__, ray.is_initialized, ray.init = ModuleSpec("ray", None), lambda: False, init
    ray.exceptions = types.SimpleNamespace(RayError=ConnectionError)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(os, "environ", {})
    with socket.create_server(("127.0.0.1", 0)) as head, pytest.raises(FleetError, match="it has died"):
        connect(f"127.0.0.1:{head.getsockname()[1]}")
    assert tries == ["2"]
