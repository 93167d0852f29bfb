"""The colours of objects, on the page and in annotated videos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

#: Colours as #rrggbb: distinguishable for colour-blind people, and light enough for dark text on them. In a picture,
#: draw each beside a dark line, so that it is visible on a light ground too.
PALETTE = (
    "#ff922b", "#3586ff", "#fedd38", "#e123c2", "#bae0b4", "#fd0304", "#76c6fe", "#5a8667", "#b7a59c",
)  # fmt: skip


class Colours:
    """Gives each object a colour, which does not change until the object is dropped.

    An object gets the first of the colours that the fewest objects have.

    Examples
    --------
    >>> colours = Colours()
    >>> [colours.of(name) for name in ("anna", "ben", "anna")]
    ['#ff922b', '#3586ff', '#ff922b']
    >>> colours.keep(["ben"])
    >>> colours.of("carl")
    '#ff922b'
    """

    def __init__(self) -> None:
        self._colours: dict[str, str] = {}

    def of(self, name: str) -> str:
        """Return the colour of an object as #rrggbb."""
        if name not in self._colours:
            used = Counter(self._colours.values())
            self._colours[name] = min(PALETTE, key=lambda colour: used[colour])
        return self._colours[name]

    def keep(self, names: Iterable[str]) -> None:
        """Drop all objects except these; their colours may be given again."""
        kept = set(names)
        self._colours = {name: colour for name, colour in self._colours.items() if name in kept}


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour #rrggbb, from 0 to 255.

    Examples
    --------
    >>> rgb("#ff922b")
    (255, 146, 43)
    """
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
