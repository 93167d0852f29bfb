"""Objects in a folder or an S3 bucket: created exclusively and never changed, without a credential in a message.

fsspec finds the credentials of S3 in the environment, in ~/.aws or in the machine's role, and the address of another
server in AWS_ENDPOINT_URL. They are not part of the URL, which is shown in messages.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from catstream.errors import FleetError, StoreError, require_extra
from catstream.fleet.timing import CONNECT_SECONDS, READ_SECONDS, STORE_SECONDS
from catstream.messages import storage

__all__ = ["Objects"]

_PROBE = "created-exclusively"
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_CODE = re.compile(r"\w{1,64}")
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_NO_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS}


class Objects:
    """The objects below a folder or a prefix of a bucket.

    Every method raises StoreError if the store cannot be reached or is full; a call that creates an object may
    nevertheless have created it.

    Parameters
    ----------
    url : folder, file:///folder or s3://bucket/prefix
    """

    def __init__(self, url: str) -> None:
        scheme, self._root = _parse(url)
        self._local = scheme == "file"
        self._url = self._root if self._local else f"s3://{self._root}"
        self._fs = _local() if self._local else _s3()
        #: Argument of each call of fsspec: it limits calls over a network, which run in a thread of fsspec.
        self._limit: dict[str, Any] = {} if self._local else {"timeout": STORE_SECONDS}
        self._checked = False

    def __repr__(self) -> str:
        return f"Objects({self._url!r})"

    def make(self) -> None:
        """Create the folder of the store, and check it. A bucket has to exist."""
        if self._local:
            with self._path("", "created") as path:
                Path(path).mkdir(parents=True, exist_ok=True)
        self._check()

    def create(self, name: str, data: bytes) -> None:
        """Create an object; FileExistsError if there is one of this name."""
        if not self._checked:
            self._check()
        self._create(name, data)

    def read(self, name: str) -> bytes:
        """Return the content of an object; FileNotFoundError if there is none."""
        with self._path(name, "read", FileNotFoundError) as path:
            content: bytes = self._fs.cat_file(path, **self._limit)
            return content

    def names(self, folder: str) -> list[str]:
        """Return the names of all objects below a folder, without the name of the folder."""
        with self._path(folder, "listed") as path:
            return [found[len(path) + 1 :] for found in self._fs.find(path, **self._limit)]

    def remove(self, name: str) -> None:
        """Remove an object, if it exists, and its folder if that is empty then."""
        with contextlib.suppress(FileNotFoundError), self._path(name, "removed", FileNotFoundError) as path:
            self._fs.rm_file(path, **self._limit)
            if self._local:
                with contextlib.suppress(OSError):  # it is not empty
                    Path(path).parent.rmdir()

    def tidy(self, folder: str) -> None:
        """Remove the old parts of files that killed processes left in a folder. S3 keeps no part of an object."""
        if self._local:
            with self._path(folder, "tidied") as path:
                for each in {found.parent for found in Path(path).rglob(".*.part")}:
                    storage.remove_parts(each)

    def _check(self) -> None:
        """Raise StoreError if the store is not there, or does not create objects exclusively."""
        if self._local and not Path(self._root).is_dir():
            raise StoreError(f"the store {self._url} is not a folder on this machine: is its file system mounted?")
        if not self._local and not (self._exists_already(_PROBE) or self._exists_already(_PROBE)):
            raise StoreError(
                f"the server of the store {self._url} ignores If-None-Match, so that two processes could write the "
                "state of one stream: use a server that supports it, such as AWS S3 or a current MinIO"
            )
        self._checked = True

    def _exists_already(self, name: str) -> bool:
        """Whether an object cannot be created because it exists; otherwise it is created."""
        try:
            self._create(name, b"")
        except FileExistsError:
            return True
        return False

    def _create(self, name: str, data: bytes) -> None:
        with self._path(name, "written", FileExistsError) as path:
            if self._local:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                storage.create_atomically(path, data)
            else:
                self._fs.pipe_file(path, data, mode="create", **self._limit)

    @contextlib.contextmanager
    def _path(self, name: str, what: str, passed: type[OSError] | tuple[()] = ()) -> Iterator[str]:
        """The path of an object; in the block, every error except those of the type `passed` becomes a StoreError."""
        try:
            yield f"{self._root}/{name}"
        except Exception as error:
            code = _code(error)
            if code == "ConditionalRequestConflict":  # another process creates the same object at this moment
                error = FileExistsError()
            if isinstance(error, passed) and code != "NoSuchBucket":
                raise type(error)(name) from None
            place = f"{name} of the store" if name else "the store"
            raise StoreError(f"{place} {self._url} cannot be {what}: {_trouble(error, code)}") from None


def _parse(url: str) -> tuple[str, str]:
    """The scheme of a URL, and the folder, or bucket and prefix. No error shows the URL: it may contain a password."""
    if "://" not in url:
        return "file", str(Path(url).resolve())
    parts = urlsplit(url)
    if parts.username is not None or parts.password is not None or parts.query or parts.fragment:
        raise FleetError(
            "the URL of the store contains a user, a password or a query: give credentials in the environment or in "
            "~/.aws/credentials, and s3://bucket/prefix only"
        )
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path:
        return "file", str(Path(parts.path).resolve())
    if parts.scheme == "s3" and _BUCKET.fullmatch(parts.netloc):
        return "s3", f"{parts.netloc}{parts.path}".rstrip("/")
    raise FleetError("the URL of the store is not valid: expected a folder, file:///folder or s3://bucket/prefix")


def _local() -> Any:
    require_extra("fleet")
    import fsspec

    return fsspec.filesystem("file")


def _s3() -> Any:
    """The file system of S3. It repeats nothing: the caller continues, and writes a newer state later."""
    require_extra("fleet")
    require_extra("s3")
    import fsspec

    for library in ("botocore", "aiobotocore"):  # at the level DEBUG they log session tokens
        logging.getLogger(library).setLevel(logging.INFO)
    limits = {"connect_timeout": CONNECT_SECONDS, "read_timeout": READ_SECONDS, "retries": {"total_max_attempts": 1}}
    fs = fsspec.filesystem("s3", skip_instance_cache=True, use_listings_cache=False, config_kwargs=limits)
    fs.retries = 1
    return fs


def _code(error: BaseException) -> str:
    """The code of an error that an S3 server answered, or ""."""
    response = getattr(error, "response", None) or getattr(error.__cause__, "response", None) or {}
    code = str(response.get("Error", {}).get("Code", ""))
    return code if _CODE.fullmatch(code) else ""


def _trouble(error: Exception, code: str) -> str:
    """Describe an error and its remedy without the text of the error, which may contain a credential."""
    if code == "NoSuchBucket":
        return "there is no such bucket: create it"
    if code:
        return f"the server answered {code}: check the bucket and its permissions"
    if isinstance(error, TimeoutError):
        return f"no answer within {STORE_SECONDS:g} s: check the network and the server"
    number = error.errno if isinstance(error, OSError) else None
    if number in _FULL:
        return f"{os.strerror(number)}: free some space there"
    if number in _NO_LINKS:
        return f"{os.strerror(number)}: the folder needs to be writable, and its file system needs hard links"
    if number is not None:
        return f"{os.strerror(number)}: check the folder, or the network and the server"
    if "Credentials" in type(error).__name__:
        return "no credentials were found: set AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    return f"{type(error).__name__}: check the network and the server"
