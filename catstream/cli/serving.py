"""Options of the commands that serve the web page: address and token."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import NamedTuple

import click

from catstream.errors import ServiceError
from catstream.services.options import PATH, Decorator, combined

#: The port of the page if none is given.
PORT = 8000

_LARGEST_PORT = 65535


class Address(NamedTuple):
    """Address that the web server listens on."""

    host: str
    port: int


class AddressType(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.2 only
    """Parameter type [HOST:]PORT; the default host is 127.0.0.1.

    >>> [tuple(AddressType().convert(text, None, None)) for text in ("8080", "0.0.0.0:8000", "[::]:0")]
    [('127.0.0.1', 8080), ('0.0.0.0', 8000), ('::', 0)]
    """

    name = "[HOST:]PORT"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Address:
        host, _, port = str(value).rpartition(":")
        if not (port.isascii() and port.isdigit() and int(port) <= _LARGEST_PORT):
            self.fail(f"expected [HOST:]PORT, for example 8000 or 0.0.0.0:8000, got {value!r}", param, ctx)
        return Address(host.removeprefix("[").removesuffix("]") or "127.0.0.1", int(port))


def with_token(prefix: str = "") -> Decorator:
    """Add --PREFIXtoken, --PREFIXtoken-file and --no-PREFIXtoken; the command gets one argument `token`.

    It is the given token, a new random one if none is given, or None with --no-PREFIXtoken.
    """

    def chosen(token: str | None, token_file: Path | None, no_token: bool) -> str | None:
        given = token or (_read(token_file) if token_file else None)
        if no_token and given:
            raise click.UsageError(
                f"--no-{prefix}token contradicts the token of --{prefix}token, --{prefix}token-file, VIEW_TOKEN or "
                "VIEW_TOKEN_FILE: leave out one of them"
            )
        return None if no_token else given or secrets.token_hex(16)

    return combined(
        "token",
        chosen,
        click.option(
            f"--{prefix}token",
            "token",
            envvar="VIEW_TOKEN",
            show_envvar=True,
            metavar="TOKEN",
            help="Token for access to the page, at least 16 characters; by default a random one.",
        ),
        click.option(
            f"--{prefix}token-file",
            "token_file",
            envvar="VIEW_TOKEN_FILE",
            show_envvar=True,
            type=PATH,
            metavar="FILE",
            help="File with this token.",
        ),
        click.option(
            f"--no-{prefix}token",
            "no_token",
            is_flag=True,
            help="Serve the page without a token: every user of this machine can watch the pictures and control it.",
        ),
    )


def _read(path: Path) -> str:
    try:
        token = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ServiceError(f"the token cannot be read from {str(path)!r}: {error}") from None
    if not token:
        raise ServiceError(f"there is no token in {str(path)!r}: write one there, for example openssl rand -hex 16")
    return token
