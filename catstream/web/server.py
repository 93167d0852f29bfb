"""The web server of a page; it runs in this thread or in one of its own."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import cast
from urllib.parse import quote

import uvicorn

from catstream.errors import ServiceError
from catstream.web.app import Site
from catstream.web.connections import MAX_CONNECTIONS, Connections
from catstream.web.guard import Guard, is_loopback
from catstream.web.timing import SHUTDOWN_SECONDS

_ALL_ADDRESSES = ("0.0.0.0", "::")  # bind addresses that include all interfaces
_GET_ADDRESS = 0x8915  # SIOCGIFADDR of Linux: the IPv4 address of a network interface


class Server:
    """The web server of a site, with access control. Its constructor begins to listen.

    Parameters
    ----------
    site : what is served
    host, port : address to listen on; port 0 for a free port
    token : token that clients must have; None, which is possible on a loopback address only, lets every user of this
        machine watch and give commands

    Attributes
    ----------
    url : URL of the page for a browser on this machine, with the token
    urls : `url`, and if the server listens on all interfaces, the URLs for other machines

    Raises
    ------
    ServiceError
        If the page would be public without a token, the token is too short, or the port is in use.
    """

    def __init__(self, site: Site, *, host: str = "127.0.0.1", port: int = 8000, token: str | None = None) -> None:
        if token is None and not is_loopback(host):
            raise ServiceError(
                f"{host} can be reached from other machines, and anyone who opens the page may control the pipeline: "
                "serve it with a token (without --no-token), or listen on 127.0.0.1"
            )
        connections = Connections(Guard(site.app, token))
        self._socket = _listen(host, port)
        bound = self._socket.getsockname()[1]
        end = f":{bound}/" + (f"?token={quote(token, safe='')}" if token else "")
        hosts = (
            ["127.0.0.1", *_addresses_of_this_machine()]
            if host in _ALL_ADDRESSES
            else [f"[{host}]" if ":" in host else host]
        )
        self.urls = [f"http://{name}{end}" for name in hosts]
        self.url = self.urls[0]
        config = uvicorn.Config(
            connections,
            http=cast("type[asyncio.Protocol]", connections.protocol),  # uvicorn only calls it
            ws="none",
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            backlog=MAX_CONNECTIONS // 2,
            timeout_graceful_shutdown=SHUTDOWN_SECONDS,
        )
        self._server = _Uvicorn(config, site.close)

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM."""
        with contextlib.suppress(KeyboardInterrupt):  # uvicorn raises it after its shutdown
            self._server.run([self._socket])

    @contextlib.contextmanager
    def in_background(self) -> Iterator[None]:
        """Serve in a thread of its own inside a `with`."""
        thread = threading.Thread(target=self._server.run, args=([self._socket],), name="view", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._server.should_exit = True
            thread.join()


class _Uvicorn(uvicorn.Server):
    """Closes the streams of open pages before the shutdown, which waits for all connections.

    A second Ctrl-C changes nothing: uvicorn would leave out the end of the site, and print the stack of it.
    """

    def __init__(self, config: uvicorn.Config, close: Callable[[], None]) -> None:
        super().__init__(config)
        self._close = close

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if not self.should_exit:
            super().handle_exit(sig, frame)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._close()
        await super().shutdown(sockets)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen(MAX_CONNECTIONS // 2)
    except OSError as error:
        listening.close()
        raise ServiceError(f"cannot listen on {host}:{port} ({error.strerror}): give another port or host") from None
    return listening


def _addresses_of_this_machine() -> list[str]:
    """Return the host name, and the IPv4 address of each network interface except the loopback."""
    names = [socket.gethostname()]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _, interface in socket.if_nameindex():
            with contextlib.suppress(OSError):  # it has no address
                answer = fcntl.ioctl(asking, _GET_ADDRESS, struct.pack("256s", interface.encode()))
                names.append(socket.inet_ntoa(answer[20:24]))
    return [name for name in names if not name.startswith("127.")]
