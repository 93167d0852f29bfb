"""The table of heads. A head is one coreset tree of the compressor, and what the trainer learns from its sample.

Compressor, trainer, checkpoint, codec, `catstream watch` and the page go by this table: a new head is a new row.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["APPEARANCE", "BACKGROUND", "EXTENT", "GROUPS", "HEADS", "OBJECT", "Head"]

#: Training rows of windows at and around the object: label 1 the object, 0 background, between them a near miss.
APPEARANCE = "appearance"
#: Training rows of the object cut at the right and at wrong sizes and aspects: the label is how well the cut fits.
EXTENT = "extent"


@dataclass(frozen=True, slots=True)
class Head:
    """One row of the table.

    name           of its tree, of its counters, and of its vector in a `Model`
    group          of the training rows that its tree takes
    label          its tree takes the feature rows of this label only. None: it takes all rows of the group, as
                   [x, 1, y] times the root of their weight, so that ||A [w; b; -1]||^2 is the squared error of a
                   linear model, and the trainer fits one by ridge regression
    ridge          penalty of the regression; the least squares of `OBJECT` against `BACKGROUND` takes the background's
    adds_to_score  its direction is a part of the score, and no sample is made before its tree has a leaf. Otherwise
                   the head is fitted to what the score leaves over, and has a vector of its own in `Model.heads`
    title          for people
    meaning        what its tree summarises, for people
    """

    name: str
    group: str
    label: float | None
    ridge: float
    adds_to_score: bool
    title: str
    meaning: str

    @property
    def more_columns(self) -> int:
        """Columns of a row of its tree beyond those of a feature row."""
        return 2 if self.label is None else 0


OBJECT = Head("object", APPEARANCE, 1.0, 1.0, True, "Object", "what the object has looked like")
BACKGROUND = Head("background", APPEARANCE, 0.0, 1.0, True, "Background", "what is around it")

#: All heads, by name.
HEADS = {
    head.name: head
    for head in (
        OBJECT,
        BACKGROUND,
        Head(
            "loss", APPEARANCE, None, 0.1, True, "Object or background",
            "both, with the score that each should get: the score is learned from these",
        ),
        Head(
            "extent", EXTENT, None, 0.1, False, "Size and shape",
            "boxes that fit the object, and boxes too large, small, wide or narrow: the box is learned from these",
        ),
    )
}  # fmt: skip

#: The groups of training rows that a frame may have.
GROUPS = tuple(dict.fromkeys(head.group for head in HEADS.values()))
