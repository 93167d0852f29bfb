"""Attach to a running pipeline, or to a stream of a fleet: subscribe to its messages, and send commands.

import catstream

with catstream.subscribe("run", "tracks") as tracks:
    for track in tracks:
        print(track.frame, track.state, track.box)

with catstream.control("fleet://cam-7") as control:
    control.set_box((120, 80, 64, 48), "anna")
"""

from __future__ import annotations

import os
from typing import Any

from catstream.client.address import Address
from catstream.client.control import Control
from catstream.client.following import StreamSubscription
from catstream.client.subscription import Subscription
from catstream.errors import ServiceError
from catstream.wire.commands import ANSWER_SECONDS
from catstream.wire.endpoint import Endpoint


def subscribe(
    address: str | os.PathLike[str] | Address,
    channel: str,
    *,
    object: str | None = None,
    timeout: float | None = None,
    keys: str = "",
    newest: bool = False,
) -> Subscription[Any]:
    """Subscribe to a channel of a running pipeline.

    Parameters
    ----------
    address : str, path or Address
        Endpoint of the pipeline, which may start later, as in the setting `run.endpoint`; empty for the only running
        pipeline of this user. Or the address of a stream of a fleet: `fleet://HOST:PORT/STREAM` with host and port of
        its registry, `fleet://FLEET/STREAM` for a fleet of this user, `fleet://STREAM` for the only one.
    channel : str
        "tracks", "models", "health", "samples", "features" or "previews": the messages are `Track`, `Model` and so on
        of `catstream.wire.messages`.
    object : str or None
        Receive only the tracks, models or samples of the object with this name; "" for the object without a name, None
        for all objects.
    timeout : float or None
        Seconds without a message after which iteration raises `SilenceError`; None to wait without limit.
    keys : str
        Folder of the keys of this client, if the pipeline requires keys.
    newest : bool
        Whether each iteration returns the newest unread track of an object, or the newest features, and skips older
        ones: for a program that reacts, and is slower than the pipeline.

    Raises
    ------
    ObjectError
        If `object` is not a valid name.
    ServiceError
        If there is no such channel, or its messages are not about one object each; if `address` is empty and not
        exactly one pipeline runs; if the fleet has no such stream; or if the keys cannot be read.
    SilenceError
        If the registry of the fleet does not answer.
    """
    address = Address.parse(address, keys)
    options: dict[str, Any] = {"object": object, "timeout": timeout, "newest": newest}
    if address.stream:
        return StreamSubscription(address.registry, address.stream, channel, **options)
    return Subscription(address.resolve(), channel, **options)


def control(
    address: str | os.PathLike[str] | Address = "",
    *,
    timeout: float = ANSWER_SECONDS,
    keys: str = "",
) -> Control:
    """Connect to a running pipeline to send commands.

    Parameters
    ----------
    address : str, path or Address
        Endpoint of the pipeline, or address of a stream of a fleet, as for `catstream.subscribe`. Connect again if the
        stream has moved.
    timeout : float
        Seconds to wait for the answer to a command.
    keys : str
        Folder of the keys of this client, if the pipeline requires keys; their role must be "control".

    Raises
    ------
    ServiceError
        If `address` is empty and not exactly one pipeline runs, if the fleet has no such stream or it is not running,
        or if the keys cannot be read.
    """
    return Control(Address.parse(address, keys).resolve(), timeout=timeout)


def wait_until_running(address: Address, seconds: float = ANSWER_SECONDS) -> Endpoint:
    """Wait for a health report of the pipeline, and return its endpoint; tracks and models may pause for long.

    SilenceError if no report arrives in time, ServiceError if the pipeline has ended, or as for `subscribe`.
    """
    with subscribe(address, "health", timeout=seconds) as reports:
        if next(reports, None) is None or reports.endpoint is None:
            reason = reports.end.reason if reports.end is not None else "it has no endpoint"
            raise ServiceError(f"{str(address) or 'the pipeline'} is not running: {reason}")
        return reports.endpoint
