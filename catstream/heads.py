"""The table of heads. A head is one coreset tree of the compressor and the regression that is trained on its sample.

Compressor, trainer, checkpoint, codec, `catstream watch` and the page use this table: a new head is a new row.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["APPEARANCE", "BACKGROUND", "EXTENT", "GROUPS", "HEADS", "OBJECT", "Head"]

#: Training rows of windows at and around the object: label 1 the object, 0 background, between them a near miss.
APPEARANCE = "appearance"
#: Training rows of windows of the right and of wrong sizes and aspects at the object: label 1 the right one, towards 0.
EXTENT = "extent"


@dataclass(frozen=True, slots=True)
class Head:
    """One row of the table.

    name           name of its tree, of its counters, and of its vector in a `Model`
    group          group of the training rows that its tree takes
    label          if given, its tree takes the feature rows x with this label only. If None, it takes all rows of the
                   group with their label y, as [x, 1, y] * sqrt(weight). Then ||A [w; b; -1]||^2 is the squared error
                   of the linear model (w, b), which the trainer minimises by ridge regression
    ridge          penalty of the regression; the least squares of `OBJECT` against `BACKGROUND` uses the background's
    adds_to_score  if true, its direction is added to the score, and no sample is made before its tree has a leaf.
                   Otherwise it is fitted to the residual of the score, and has its own vector in `Model.heads`
    title          title on the page
    meaning        description of its tree on the page
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
        """Number of columns of its tree in addition to those of a feature row."""
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
