"""Objects in a folder or an S3 bucket: created exclusively and never changed, without a credential in a message.

The credentials of S3 come from the environment, the machine's role, or ~/.aws; the address of another server from
AWS_ENDPOINT_URL. They are not part of the URL, which is shown in messages.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterator
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from catstream.errors import FleetError, StoreError, require_extra
from catstream.fleet.timing import CONNECT_SECONDS, STORE_SECONDS
from catstream.messages import storage

_PROBE = "created-exclusively"
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_CODE = re.compile(r"<Code>(\w{1,64})</Code>")  # in an answer of S3
_ROLE = "/latest/"  # in the address at which a machine asks for the credentials of its role
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
        bucket, path = _parse(url)
        self._url = f"s3://{bucket}/{path}".rstrip("/") if bucket else path
        self._place: _Bucket | _Folder = _Bucket(bucket, path) if bucket else _Folder(Path(path))
        self._checked = False

    def __repr__(self) -> str:
        return f"Objects({self._url!r})"

    def make(self) -> None:
        """Create the folder of the store, and check it. A bucket has to exist."""
        with self._errors("", "created"):
            self._place.make()
        self._check()

    def create(self, name: str, data: bytes) -> None:
        """Create an object; FileExistsError if there is one of this name."""
        if not self._checked:
            self._check()
        with self._errors(name, "written", FileExistsError):
            self._place.create(name, data)

    def read(self, name: str) -> bytes:
        """Return the content of an object; FileNotFoundError if there is none."""
        with self._errors(name, "read", FileNotFoundError):
            return self._place.read(name)

    def names(self, folder: str) -> list[str]:
        """Return the names of all objects below a folder, without the name of the folder."""
        with self._errors(folder, "listed"):
            return self._place.names(folder)

    def remove(self, name: str) -> None:
        """Remove an object, if it exists, and its folder if that is empty then."""
        with contextlib.suppress(FileNotFoundError), self._errors(name, "removed", FileNotFoundError):
            self._place.remove(name)

    def tidy(self, folder: str) -> None:
        """Remove the old parts of files that killed processes left in a folder. S3 keeps no part of an object."""
        with self._errors(folder, "tidied"):
            self._place.tidy(folder)

    def _check(self) -> None:
        """Raise StoreError if the store is not there, or does not create objects exclusively."""
        with self._errors(_PROBE, "written"):
            missing = self._place.missing()
        if missing:
            raise StoreError(f"the store {self._url} {missing}")
        self._checked = True

    @contextlib.contextmanager
    def _errors(self, name: str, what: str, passed: type[OSError] | tuple[()] = ()) -> Iterator[None]:
        """In the block, every error becomes a StoreError, except those of the type `passed`."""
        try:
            yield
        except Exception as error:
            code = found[1] if (found := _CODE.search(str(error))) else ""
            if isinstance(error, passed) and code != "NoSuchBucket":
                raise type(error)(name) from None
            place = f"{name} of the store" if name else "the store"
            raise StoreError(f"{place} {self._url} cannot be {what}: {_trouble(error, code)}") from None


class _Folder:
    """Objects as files below a folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def make(self) -> None:
        self._root.mkdir(parents=True, exist_ok=True)

    def missing(self) -> str:
        return "" if self._root.is_dir() else "is not a folder on this machine: is its file system mounted?"

    def create(self, name: str, data: bytes) -> None:
        path = self._root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        storage.create_atomically(path, data)

    def read(self, name: str) -> bytes:
        return (self._root / name).read_bytes()

    def names(self, folder: str) -> list[str]:
        root = self._root / folder
        found = (Path(path, file) for path, _, files in os.walk(root, onerror=_raise_unless_gone) for file in files)
        return [str(path.relative_to(root)) for path in found]

    def remove(self, name: str) -> None:
        path = self._root / name
        path.unlink()
        with contextlib.suppress(OSError):  # it is not empty
            path.parent.rmdir()

    def tidy(self, folder: str) -> None:
        for each in {found.parent for found in (self._root / folder).rglob(".*.part")}:
            storage.remove_parts(each)


def _raise_unless_gone(error: OSError) -> None:
    """Another process removes empty folders."""
    if not isinstance(error, FileNotFoundError):
        raise error


class _Bucket:
    """Objects below a prefix of an S3 bucket."""

    def __init__(self, bucket: str, prefix: str) -> None:
        require_extra("s3")
        self._bucket, self._prefix = bucket, prefix

    @cached_property
    def _store(self) -> Any:
        """The bucket, to which requests are sent once: the caller continues, and writes a newer state later."""
        from obstore.store import S3Store

        limits: Any = {
            "timeout": timedelta(seconds=STORE_SECONDS),
            "connect_timeout": timedelta(seconds=CONNECT_SECONDS),
        }
        return S3Store(
            self._bucket,
            prefix=self._prefix or None,
            client_options=limits | {"allow_http": True},  # at an address that begins with http
            retry_config={"max_retries": 0},
            credential_provider=_credentials(),
            disable_bulk_delete=True,  # one object each time, and not all servers have it
        )

    def make(self) -> None:
        """It has to exist."""

    def missing(self) -> str:
        for _ in range(2):
            try:
                self.create(_PROBE, b"")
            except FileExistsError:
                return ""
        return (
            "is on a server that ignores If-None-Match, so that two processes could write the state of one stream: "
            "use a server that supports it, such as AWS S3 or a current MinIO"
        )

    def create(self, name: str, data: bytes) -> None:
        from obstore.exceptions import AlreadyExistsError

        try:
            self._store.put(name, data, mode="create")
        except AlreadyExistsError:  # also: another process creates it at this moment
            raise FileExistsError(name) from None

    def read(self, name: str) -> bytes:
        return bytes(self._store.get(name).bytes())

    def names(self, folder: str) -> list[str]:
        return [each["path"][len(folder) + 1 :] for each in self._store.list(folder).collect()]

    def remove(self, name: str) -> None:
        self._store.delete(name)

    def tidy(self, folder: str) -> None:
        """There is nothing to do."""


def _credentials() -> Any:
    """What reads ~/.aws: profiles, roles, sessions; None if there is nothing, or the environment has a key."""
    variables = {"AWS_SHARED_CREDENTIALS_FILE": "~/.aws/credentials", "AWS_CONFIG_FILE": "~/.aws/config"}
    files = [Path(os.environ.get(name, usual)).expanduser() for name, usual in variables.items()]
    if "AWS_ACCESS_KEY_ID" in os.environ or not ("AWS_PROFILE" in os.environ or any(file.exists() for file in files)):
        return None
    from obstore.auth.boto3 import Boto3CredentialProvider  # half a second of imports

    return Boto3CredentialProvider()


def _parse(url: str) -> tuple[str, str]:
    """The bucket of a URL and the prefix, or "" and the folder. No error shows the URL: it may contain a password."""
    if "://" not in url:
        return "", str(Path(url).resolve())
    parts = urlsplit(url)
    if parts.username is not None or parts.password is not None or parts.query or parts.fragment:
        raise FleetError(
            "the URL of the store contains a user, a password or a query: give credentials in the environment or in "
            "~/.aws/credentials, and s3://bucket/prefix only"
        )
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path:
        return "", str(Path(parts.path).resolve())
    if parts.scheme == "s3" and _BUCKET.fullmatch(parts.netloc):
        return parts.netloc, parts.path.strip("/")
    raise FleetError("the URL of the store is not valid: expected a folder, file:///folder or s3://bucket/prefix")


def _trouble(error: Exception, code: str) -> str:
    """Describe an error and its remedy without the text of the error, which may contain a credential."""
    text = str(error)
    if code == "NoSuchBucket":
        return "there is no such bucket: create it"
    if code in ("PermanentRedirect", "AuthorizationHeaderMalformed") or "incorrectly configured region" in text:
        return "the bucket is in another region: set AWS_REGION"
    if code:
        return f"the server answered {code}: check the bucket and its permissions"
    if _ROLE in text or type(error).__module__.startswith("botocore") or isinstance(error, ValueError):
        return "no credentials were found: set AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
    if "kind: Timeout" in text:
        return f"no answer within {STORE_SECONDS:g} s: check the network and the server"
    number = error.errno if isinstance(error, OSError) else None
    if number in _FULL:
        return f"{os.strerror(number)}: free some space there"
    if number in _NO_LINKS:
        return f"{os.strerror(number)}: the folder needs to be writable, and its file system needs hard links"
    if number is not None:
        return f"{os.strerror(number)}: check the folder, or the network and the server"
    return f"{type(error).__name__}: check the network and the server"
