"""The server of the registry of a fleet, which locates streams: see `catstream.client.registry`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace

import msgspec

from catstream.wire.channels import REGISTRY
from catstream.wire.commands import Responder
from catstream.wire.discovery import private_folder, reserve_endpoint
from catstream.wire.messages import FleetStatus, Listing, Question


class RegistryServer:
    """Answers the questions of clients about the streams and nodes of a fleet.

    It listens at tcp://HOST:PORT with the keys of a folder, or in a folder of Unix sockets, by default a new one. Other
    processes of this user find it by the fleet's name.
    """

    def __init__(self, listen: str, keys: str, status: Callable[[], FleetStatus]) -> None:
        self._status = status
        with ExitStack() as stack:
            folder = stack.enter_context(private_folder())
            self.endpoint = stack.enter_context(reserve_endpoint(listen, folder, keys, fleet=status().name))
            self._responder = stack.enter_context(Responder[Question, Listing](REGISTRY, self.endpoint))
            self.close = stack.pop_all().close

    def serve(self, seconds: float = 0.0) -> int:
        """Answer all questions, waiting up to `seconds` for the first; returns their number."""
        questions = self._responder.receive_all(seconds)
        status = self._status() if questions else None
        for question in questions:
            answer = status
            if status is not None and (name := question.stream):
                streams = {name: status.streams[name]} if name in status.streams else {}
                answer = replace(status, streams=streams, nodes={})
            self._responder.answer(Listing(question.id, msgspec.json.encode(answer)))
        return len(questions)
