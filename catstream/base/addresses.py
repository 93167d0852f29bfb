"""Addresses of sources: recognises live sources, and removes passwords from messages, logs and health reports."""

from __future__ import annotations

import re
from itertools import takewhile
from pathlib import Path

_LIVE = re.compile(r"\d+|/dev/video\d+|demo:.*|(?!(?i:file):)[a-zA-Z][\w+.-]+://.+", re.DOTALL)

#: A URL, with one slash or more; or a user and a password before a host.
_ADDRESS = re.compile(r"(?:([a-z][a-z0-9+.-]*):/+|(?=[^/@]*:[^@]*@))(.*)", re.IGNORECASE | re.DOTALL)
_HOST = re.compile(r"([\w.-]*|\[[\w:.%]+\])(:\d+)?")
_PLAIN = re.compile(r"(?!.*(pass|pwd|token|secret|auth|key|login|user|usr|cred|sign))[\w.~+,-]*", re.IGNORECASE)

#: A word that may be an address with a password.
_SUSPECT = re.compile(r"""[^\s'"()]*:[^\s'"()]*[@=][^\s'"()]*""")


def is_live(text: str | Path) -> bool:
    """Return True if a text names a live source. A number is a camera; write ./0 for a folder named 0.

    >>> [is_live(text) for text in ("0", "/dev/video2", "rtsp://10.0.0.7/stream", "demo:1", "./0", "walk.mp4")]
    [True, True, True, True, False, False]
    """
    return _LIVE.fullmatch(str(text)) is not None


def without_password(source: str) -> str:
    """Redact the address of a stream; any other source is returned unchanged.

    The protocol, the host and the path remain, up to the first component of the path that looks like a password.

    >>> without_password("rtsp://me:secret@10.0.0.7/stream1"), without_password("http://10.0.0.7/video.cgi?pwd=secret")
    ('rtsp://10.0.0.7/stream1', 'http://10.0.0.7/video.cgi?...')
    >>> without_password("rtsp://me:1/2@3#4@10.0.0.7:554/one")  # not a valid URL: these characters need escapes
    'rtsp://10.0.0.7:554/one'
    >>> without_password("rtsp://10.0.0.7/user=me_password=secret_channel=1.sdp")
    'rtsp://10.0.0.7/...'
    """
    parts = _ADDRESS.fullmatch(source)
    if parts is None or (parts[1] or "").lower() == "file":
        return source
    protocol, rest = f"{parts[1]}://" if parts[1] else "", parts[2]
    if re.search(r"\?.*=.*@", rest, re.DOTALL) and "@" not in re.split("[/?#]", rest)[0]:
        return f"{protocol}..."  # the password may be before or after the @
    location, query, _ = re.split("([?#]|$)", rest.rpartition("@")[2], maxsplit=1)
    host, *path = location.split("/")
    if not _HOST.fullmatch(host):
        return f"{protocol}..."
    plain = [*takewhile(_PLAIN.fullmatch, path)]
    return protocol + "/".join([host, *plain]) + ("/..." if len(plain) < len(path) else "?..." if query else "")


def without_passwords(text: str) -> str:
    """Redact all addresses in a text.

    >>> without_passwords("a box is x,y,w,h, got 'rtsp://me:secret@10.0.0.7/one'")
    "a box is x,y,w,h, got 'rtsp://10.0.0.7/one'"
    """
    return _SUSPECT.sub(lambda word: without_password(word[0]), text)
