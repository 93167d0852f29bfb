"""The table of heads. A head is one coreset tree of the compressor, and what the trainer computes from its sample.

Each tree with all rows of a group has a ridge regression of its own. Object and background share one: least squares of
the object's mean against the background's mean and covariance. Only the one-class classifier uses the object's rows.

Compressor, trainer, checkpoint, codec, `catstream watch` and the page use this table: a new head is a new row.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["APPEARANCE", "ASPECT", "BETWEEN_RIDGE", "EXTENT", "GROUPS", "HEADS", "SIZE", "Head"]

#: Training rows of windows at and around the object: label 1 the object, 0 background, between them a near miss.
APPEARANCE = "appearance"
#: Training rows of windows of the right and of wrong sizes and aspects at the object: label 1 the right one, towards 0.
EXTENT = "extent"
#: Training rows of windows of the right and of wrong sizes: label 0.5 the right one, larger for windows too large.
SIZE = "size"
#: Training rows of windows of the right and of wrong aspect ratios: label 0.5 the right one, larger for too wide ones.
ASPECT = "aspect"


@dataclass(frozen=True, slots=True)
class Head:
    """One row of the table.

    name           name of its tree, of its counters, and of its vector in a `Model`
    group          group of the training rows that its tree takes
    label          if given, its tree takes the feature rows x with this label only. If None, it takes all rows of the
                   group with their label y, as [x, 1, y] * sqrt(weight). Then ||A [w; b; -1]||^2 is the squared error
                   of the linear model (w, b), which the trainer minimises by ridge regression
    ridge          penalty of its ridge regression; None for object and background, see `BETWEEN_RIDGE`
    adds_to_score  if true, its tree is used for the weights of the score, so that no sample is made before it has a
                   leaf. Otherwise its regression is in `Model.heads`
    has_bias       if true, its regression predicts the label, with b in `Model.biases`. If false and it does not add to
                   the score, it is fitted to the residual of the score
    title          title on the page
    meaning        description of its tree on the page
    """

    name: str
    group: str
    label: float | None
    ridge: float | None
    adds_to_score: bool
    has_bias: bool
    title: str
    meaning: str

    @property
    def more_columns(self) -> int:
        """Number of columns of its tree in addition to those of a feature row."""
        return 2 if self.label is None else 0


#: Penalty of the least squares of the object's mean against the background's mean and covariance.
BETWEEN_RIDGE = 1.0

#: All heads, by name.
HEADS = {
    head.name: head
    for head in (
        Head("object", APPEARANCE, 1.0, None, True, False, "Object", "what the object has looked like"),
        Head("background", APPEARANCE, 0.0, None, True, False, "Background", "what is around it"),
        Head(
            "loss", APPEARANCE, None, 0.1, True, False, "Object or background",
            "both, with the score that each should get: the score is learned from these",
        ),
        Head(
            "extent", EXTENT, None, 0.1, False, False, "Size and shape",
            "boxes that fit the object, and boxes too large, small, wide or narrow: the box is learned from these",
        ),
        Head(
            "size", SIZE, None, 0.03, False, True, "Size",
            "boxes too large and too small: the error of the box's size is learned from these",
        ),
        Head(
            "aspect", ASPECT, None, 0.03, False, True, "Shape",
            "boxes too wide and too narrow: the error of the box's shape is learned from these",
        ),
    )
}  # fmt: skip

#: The groups of training rows that a frame may have.
GROUPS = tuple(dict.fromkeys(head.group for head in HEADS.values()))
