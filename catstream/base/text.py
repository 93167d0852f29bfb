"""Formats numbers and names for messages."""

from __future__ import annotations

from collections.abc import Iterable


def listed(names: Iterable[str]) -> str:
    """Join names of objects for a message.

    >>> listed(["anna", ""]), listed([])
    ('anna, the object without a name', 'none')
    """
    return ", ".join(name or "the object without a name" for name in names) or "none"


def counted(number: float, noun: str) -> str:
    """A number and a noun, in the singular or the plural.

    >>> counted(1, "frame"), counted(0, "frame")
    ('1 frame', '0 frames')
    """
    return f"{number:.0f} {noun}" if number == 1 else f"{number:.0f} {noun}s"
