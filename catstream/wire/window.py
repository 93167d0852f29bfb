"""The window: messages that were sent and not yet stored, and which of them goes out next.

No socket in here. Messages are known by their numbers 1, 2, 3 ...; a receiver acknowledges
"all up to this one"; after a new connection it says where it stands, and all that it does not
have goes out again.
"""

from __future__ import annotations

from collections import deque

from catstream.errors import ProtocolError

__all__ = ["Window"]


class Window:
    """Holds each message until it is stored.

    Parameters
    ----------
    size : messages held at which it is full

    >>> window = Window(size=2)
    >>> window.add(1, b"one"), window.add(2, b"two"), window.full
    (None, None, True)
    >>> window.next, window.sent(), window.next
    (b'one', None, b'two')
    >>> window.rewind(0), window.next
    (None, b'one')
    >>> window.forget(1), window.next, window.full
    (None, b'two', False)
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.newest = 0
        self.stored = 0
        self._messages: deque[bytes] = deque()
        self._sent = 0  # of those held

    @property
    def full(self) -> bool:
        """Whether the sender should wait."""
        return len(self._messages) >= self.size

    @property
    def empty(self) -> bool:
        """Whether all that was added is stored."""
        return not self._messages

    @property
    def next(self) -> bytes | None:
        """The message to put on the wire, None where all of them are."""
        return self._messages[self._sent] if self._sent < len(self._messages) else None

    def sent(self) -> None:
        """`next` is on the wire."""
        self._sent += 1

    def add(self, seq: int, message: bytes) -> None:
        """Take a message; one that the receiver has stored already is dropped.

        Raises
        ------
        ProtocolError
            Where one is missing before it.
        """
        if seq <= self.stored:
            return
        if seq != max(self.newest, self.stored) + 1:
            raise ProtocolError(
                f"message {seq} cannot follow {max(self.newest, self.stored)}: send every one, in order"
            )
        self._messages.append(message)
        self.newest = seq

    def forget(self, seq: int) -> None:
        """All up to `seq` are stored.

        Raises
        ------
        ProtocolError
            Where `seq` was never sent.
        """
        if self._messages and seq > self.newest:
            raise ProtocolError(f"message {seq} was acknowledged, but the last one sent is {self.newest}")
        for _ in range(min(seq - self.stored, len(self._messages))):
            self._messages.popleft()
            self._sent = max(self._sent - 1, 0)
        self.stored = max(self.stored, seq)

    def rewind(self, seq: int) -> None:
        """A receiver that has stored all up to `seq`, and nothing after it, is there: send it the rest.

        Raises
        ------
        ProtocolError
            Where it does not have what was acknowledged before.
        """
        if seq < self.stored:
            raise ProtocolError(
                f"the receiver has stored {seq} messages, {self.stored} were acknowledged: "
                "it came back without what it had stored, start everything anew"
            )
        self.forget(seq)
        self._sent = 0
